// A browser for the tests of the page, what axe finds wrong with a page, and the errors that a page reports.

import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { chromium } from "playwright-core";

export const patience = { timeout: 60_000 };
export const axe = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");
const args = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
  "--disable-component-update", "--disable-sync"];

/** Call act(browser) with a new browser, and end it and this program. */
export async function withBrowser(executablePath, profile, act) {
  const browser = await chromium.launchPersistentContext(profile, { executablePath, headless: true, args });
  try {
    await act(browser);
  } finally {
    await browser.close();
  }
  process.exit(0);
}

/** The list of the errors that a page reports from now on. */
export function errorsOf(page) {
  const wrong = [];
  page.on("console", (message) => message.type() === "error" && wrong.push(message.text()));
  page.on("pageerror", (error) => wrong.push(error.message));
  return wrong;
}

/** The place of an element in the window, even if it is replaced again and again, as a picture is. */
export function placeOf(page, selector) {
  return page.evaluate((each) => document.querySelector(each).getBoundingClientRect().toJSON(), selector);
}

/** The place in the window of a place in a frame of this size, which the page shows; also if it is zoomed. */
export async function placeIn(page, [width, height], [x, y]) {
  const view = await placeOf(page, "#picture");
  const scale = Math.min(view.width / width, view.height / height);
  return [view.x + (view.width - width * scale) / 2 + x * scale, view.y + (view.height - height * scale) / 2 + y * scale];
}

/** Drag with the mouse from a place in the frame to another. */
export async function drag(page, size, [left, top], [right, bottom]) {
  await page.mouse.move(...await placeIn(page, size, [left, top]));
  await page.mouse.down();
  await page.mouse.move(...await placeIn(page, size, [(left + right) / 2, (top + bottom) / 2]));
  await page.mouse.move(...await placeIn(page, size, [right, bottom]));
  await page.mouse.up();
}

/** Draw a box, in pixels of a frame of this size, by mouse in the picture of the page. */
export const drawOn = (page, size, [x, y, w, h]) => drag(page, size, [x, y], [x + w, y + h]);

/** A function that sends a touch event at places in the picture, which are shares of its width and height. */
export async function touchOn(page, browser) {
  const session = await browser.newCDPSession(page), view = await placeOf(page, "#picture");
  await session.send("Emulation.setTouchEmulationEnabled", { enabled: true });
  return (type, ...places) => {
    const touchPoints = places.map(([x, y], id) => ({ x: view.x + x * view.width, y: view.y + y * view.height, id }));
    return session.send("Input.dispatchTouchEvent", { type, touchPoints });
  };
}

/** What axe, which the page has evaluated, finds wrong with it. */
export async function violationsOf(page) {
  const { violations } = await page.evaluate(() => axe.run({ resultTypes: ["violations"] }));
  return violations.map(({ id, nodes }) => `${id}: ${nodes.map(({ html, any }) => `${html} ${any[0]?.message ?? ""}`).join("; ")}`);
}
