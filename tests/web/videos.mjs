// What a person does on the page of catstream annotate with several videos; says what was seen, a line each.
//   node videos.mjs URL CHROMIUM PROFILE WIDTH HEIGHT BOX, with the size of all videos and a box that is in them as JSON

import { drawOn, errorsOf, patience, withBrowser } from "./browser.mjs";

const [url, executablePath, profile, width, height, box] = process.argv.slice(2);

await withBrowser(executablePath, profile, async (browser) => {
  const page = await browser.newPage(), wrong = errorsOf(page);
  await page.goto(url);
  const says = (selector, words) => page.waitForFunction(([each, wanted]) => document.querySelector(each).textContent.includes(wanted), [selector, words], patience);
  const draw = async (video) => {
    await page.waitForSelector(`#picture[src="frames/0.jpg${video ? `?video=${video}` : ""}"]`, patience);
    await drawOn(page, [Number(width), Number(height)], JSON.parse(box));
    await says("#check", "object-1 in frame 0: your box");
  };

  await draw(0);
  console.log("first", await page.locator("#source").innerText());
  await page.fill("#name", "anna");
  await page.click("#video"); // the name is saved
  await draw(1);
  await page.fill("#name", "ben");
  await page.click("#list button >> nth=0");
  await says("#check", "anna in frame 0: your box");
  console.log("videos", (await page.locator("#list b").allInnerTexts()).join(), (await page.locator("#list [aria-pressed=true]").count()));
  await page.keyboard.press("Control+Enter");
  await says("#overlay", "Done");
  console.log("errors", JSON.stringify(wrong.filter((line) => !/40[04]|ERR_/.test(line))));
});
