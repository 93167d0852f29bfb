// What a person does on the page of a fleet, in a real browser; says what was seen, as JSON, a line each.
//   node fleet.mjs URL CHROMIUM PROFILE; after the line "silence" the fleet stops to answer

import { axe, errorsOf, patience, violationsOf, withBrowser } from "./browser.mjs";

const [url, executablePath, profile] = process.argv.slice(2);
const say = (name, value) => console.log(JSON.stringify([name, value]));

await withBrowser(executablePath, profile, async (browser) => {
  const page = await browser.newPage();
  const wrong = errorsOf(page);
  const shown = () => page.locator("#fleet li > a").allInnerTexts();
  const until = (condition, value) => page.waitForFunction(condition, value, patience);
  const check = async (state) => {
    for (const [colorScheme, width, height] of [["light", 1440, 900], ["dark", 390, 844]]) {
      await page.setViewportSize({ width, height });
      await page.emulateMedia({ colorScheme });
      say("violations", (await violationsOf(page)).map((text) => `${state}, ${colorScheme}: ${text}`));
      say("too wide", await page.evaluate(() => Math.max(0, document.documentElement.scrollWidth - innerWidth)));
    }
    await page.setViewportSize({ width: 1440, height: 900 });
  };

  await page.goto(url);
  await page.waitForSelector("#fleet .wall > li", patience);
  await until(() => document.querySelector("#state").textContent.trim() === "1 in trouble");
  await page.evaluate(axe);
  say("all", await shown());
  say("wall", await page.locator("#fleet .bar li").allInnerTexts());
  await until(() => document.querySelector(".wall img.there")?.naturalWidth > 0);
  say("picture", true);
  say("nodes", await page.locator("#nodes tbody td:first-child").allInnerTexts());
  await check("all");
  await page.focus('#fleet a:text-is("cam-7")');
  await page.keyboard.press("Enter");
  await until(() => document.querySelector("#source")?.textContent.startsWith("cam-7, walk.mp4"));
  say("page", [new URL(page.url()).pathname, await page.title()]);
  await page.goBack();
  await until(() => document.querySelector("#fleet .wall > li"));
  say("back", await shown());
  await page.goto(new URL("streams/cam-7/", url).href);
  await page.click("#all");
  await until(() => document.querySelector("#fleet .wall > li"));
  say("fleet", await shown());
  console.log('["silence"]');
  await page.waitForSelector("#streams.old", patience);
  await page.evaluate(axe);
  say("silent", await page.locator("#silence").innerText());
  await check("silent");
  say("errors", wrong.filter((text) => !/404/.test(text))); // a picture may be gone when it is asked for
});
