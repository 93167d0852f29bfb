// A box is drawn late in a picture of a camera; says which picture, then what the pipeline answered.
//   node live.mjs URL CHROMIUM PROFILE SECONDS [SCREENSHOTS], then on standard input: the box

import { createInterface } from "node:readline";
import { errorsOf, patience, withBrowser } from "./browser.mjs";

const [url, executablePath, profile, seconds, screenshots] = process.argv.slice(2);

await withBrowser(executablePath, profile, async (browser) => {
  const page = await browser.newPage();
  const wrong = errorsOf(page);
  const shoot = async (name) => screenshots && page.screenshot({ path: `${screenshots}/${name}.png` });
  await page.goto(url);
  await page.waitForFunction(() => document.querySelector("#overlay").textContent === "", null, patience);
  await page.click("#draw", patience);
  const shown = () => page.evaluate(() => document.querySelector("#picture").src.match(/pictures\/(.*)\.jpg/)[1]);
  const time = await shown();
  console.log("picture", time);
  const lines = createInterface({ input: process.stdin });
  const { value } = await lines[Symbol.asyncIterator]().next();
  const [left, top, wide, tall] = value.split(",").map(Number);
  const at = (x, y) => page.evaluate(([x, y]) => new DOMPoint(x, y).matrixTransform(document.querySelector("#stage svg").getScreenCTM()).toJSON(), [x, y]);
  const corners = [await at(left, top), await at(left + wide / 2, top + tall / 2), await at(left + wide, top + tall)];
  await page.mouse.move(corners[0].x, corners[0].y);
  await page.mouse.down();
  for (const { x, y } of corners.slice(1)) await page.mouse.move(x, y);
  await page.mouse.up();
  await shoot("drawn");
  await page.waitForTimeout(1000 * seconds);
  console.log("still", (await shown()) === time);
  await page.click("#follow:not([disabled])", patience);
  await page.waitForFunction(() => document.querySelector("#message").textContent.includes("begins"), null, patience);
  console.log("answer", await page.locator("#message").innerText());
  await page.waitForSelector('#state[data-state="present"]', patience);
  await shoot("followed");
  console.log("errors", JSON.stringify(wrong));
});
