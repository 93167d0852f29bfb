// What a person does on the page of catstream batch --ask, by mouse and keys; says what was seen, a line each.
//   node batch.mjs URL CHROMIUM PROFILE SIZES BOX, with the size of each video and a box that is in all of them as JSON

import { axe, drawOn, errorsOf, patience, violationsOf, withBrowser } from "./browser.mjs";

const [url, executablePath, profile, ...words] = process.argv.slice(2);
const [sizes, box] = words.map((word) => JSON.parse(word));

await withBrowser(executablePath, profile, async (browser) => {
  const page = await browser.newPage();
  const wrong = errorsOf(page);
  await page.goto(url);
  const text = (selector) => page.locator(selector).innerText();
  const says = (selector, words) => page.waitForFunction(([each, wanted]) => document.querySelector(each).textContent.includes(wanted), [selector, words], patience);
  const drawn = async (words) => { // the answer to a box may come after the news of it
    await says("#check", words);
    await page.waitForSelector("#stage .shade", { state: "detached", ...patience });
  };
  const shows = (number) => page.waitForSelector(`#picture[src="frames/${number}.jpg"]`, patience);
  const name = async (words) => {
    await page.fill("#name", words);
    await page.press("#name", "Enter");
  };

  await shows(0);
  console.log("first", await text("#source"), await text("#frame"));
  await page.keyboard.press("Control+Enter");
  await says("#message", "no box is drawn");
  await name("anna");
  await drawOn(page, sizes[0], box);
  await drawn("anna: your box");
  await page.keyboard.press("o");
  await name("ben");
  await drawOn(page, sizes[0], [...box.map((side) => side / 2)]);
  await drawn("ben: your box");
  await says("#timelines", "ben");

  await page.keyboard.press("n");
  await shows(1);
  await says("#check", "anna: no box");
  await drawOn(page, sizes[1], box);
  await drawn("ben: no box"); // the next object
  await drawOn(page, sizes[1], box);
  await drawn("ben: your box");
  await page.keyboard.press("u");
  await says("#check", "ben: no box");
  console.log("second", await text("#source"), await text("#frame"), "|", await text("#next"));
  await page.keyboard.press("b");
  await shows(0);
  await says("#check", "your box");
  console.log("shares", (await page.locator("#timelines .share").allInnerTexts()).join());
  await page.evaluate(axe);
  console.log("violations", JSON.stringify(await violationsOf(page)));
  await page.keyboard.press("Control+Enter");
  await says("#overlay", "Done: the command tracks the videos now");
  console.log("errors", JSON.stringify(wrong.filter((line) => !/40[04]|ERR_/.test(line))));
});
