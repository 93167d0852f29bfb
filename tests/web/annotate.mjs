// What a person does on the page of catstream annotate, by mouse and keys; says what was seen, a line each.
//   node annotate.mjs URL CHROMIUM PROFILE BOXES WIDTH HEIGHT, with the boxes in the first and the last frame as JSON

import { axe, drag, drawOn, errorsOf, patience, placeIn, touchOn, violationsOf, withBrowser } from "./browser.mjs";

const [url, executablePath, profile, boxes, ...size] = process.argv.slice(2);
const [first, last] = JSON.parse(boxes);

await withBrowser(executablePath, profile, async (browser) => {
  const page = await browser.newPage();
  await page.setViewportSize({ width: 1100, height: 800 });
  const wrong = errorsOf(page);
  await page.goto(url);
  const text = (selector) => page.locator(selector).innerText();
  const says = (selector, words) => page.waitForFunction(([each, wanted]) => document.querySelector(each).textContent.includes(wanted), [selector, words], patience);
  const draw = (box) => drawOn(page, size.map(Number), box);
  const name = async (words) => {
    await page.fill("#name", words);
    await page.press("#name", "Enter");
  };
  const keys = async (...each) => {
    for (const key of each) await page.keyboard.press(key);
  };

  const undone = () => page.waitForFunction(() => !document.querySelector("#check").textContent.includes("your box"), null, patience);

  await page.waitForFunction(() => document.querySelector("#overlay").textContent === "", null, patience);
  await says("#next", "Draw the first box");
  await name("no name");
  await draw(first);
  await says("#message", "is not a name");
  console.log("refused", await text("#message"));
  await name("anna");
  await draw(first);
  await says("#check", "anna in frame 0: your box");
  await says("#next", "Look next at frame 23, anna");
  await keys("n");
  await says("#check", "anna in frame 23");
  await page.waitForSelector('#picture[src="frames/23.jpg"]', patience);
  await keys("d", "ArrowLeft", "Shift+ArrowUp", "Enter");
  await says("#check", "anna in frame 23: your box");
  await page.waitForSelector("#stage .shade", { state: "detached", ...patience }); // the answer may come after the news
  await keys("u");
  await undone();
  await draw(last);
  await says("#next", "All frames are checked");
  console.log("checked", await text("#timelines"));

  await keys("ArrowLeft");
  await says("#check", "anna in frame 22: checked");
  await keys("PageUp");
  await says("#check", "anna in frame 0: your box");
  await keys("o");
  await name("ben");
  await draw([20, 150, 60, 60]);
  await says("#check", "ben in frame 0: your box");
  await says("#next", "Look next at frame 23, ben");
  await page.click("#next");
  await page.waitForSelector('#picture[src="frames/23.jpg"]', patience);
  await keys("h");
  await says("#check", "ben in frame 23: hidden");
  await keys("a");
  await says("#check", "ben in frame 23: absent, your box");
  await draw([220, 170, 60, 60]); // another place: the directions do not agree
  await says("#check", "ben in frame 23: your box");
  await page.waitForFunction(() => !document.querySelector("#next").disabled, null, patience);
  await keys("n");
  await says("#check", "may be wrong");
  console.log("proposals", (await page.locator("#stage text").allTextContents()).sort().join());
  await keys("1");
  await says("#check", "your box");
  await keys("b");
  await says("#check", "ben in frame 23");
  await name("carl");
  await says("#timelines", "carl");
  await says("#check", "carl in frame 23: your box");
  await keys("Control+z"); // the new name
  await says("#check", "ben in frame 23: your box");
  await keys("Control+z");
  await undone();
  await keys("End");
  await says("#check", "ben in frame 23: your box");
  await keys("Backspace");
  await undone();
  await keys("Home");
  await says("#check", "ben in frame 0: your box");
  await page.click("#delete"); // with its last box, the object
  await says("#check", "A new object");
  await page.evaluate(() => dispatchEvent(new KeyboardEvent("keydown", { key: "\u0433", code: "KeyU" }))); // of a Cyrillic keyboard
  await says("#check", "ben in frame 0: your box");
  await keys("u");
  await says("#check", "ben in frame 23: your box");
  await keys("Shift+Delete");
  await says("#check", "A new object");
  await page.click("#undo");
  await says("#check", "ben in frame 23: your box");
  await keys("?");
  await page.waitForSelector("#keys[open]", patience);
  await keys("Delete", "Escape");
  await page.locator("#timelines svg").first().click();
  await page.waitForFunction(() => /anna in frame 1[12]: checked/.test(document.querySelector("#check").textContent), null, patience); // the middle
  // Zoom: an edge is dragged, arrows move the box by a pixel, and leaving the frame saves it.
  const box = () => page.evaluate(() => { const { x, y, width, height } = document.querySelector("#stage rect.thick").attributes; return [x, y, width, height].map(({ value }) => Number(value)); });
  await keys("Home");
  await says("#check", "anna in frame 0: your box");
  const before = await box(), whole = await page.textContent("#whole");
  const isWhole = (expected) => page.waitForFunction(([text, is]) => (document.querySelector("#whole").textContent === text) === is, [whole, expected], patience);
  await page.mouse.move(...await placeIn(page, size.map(Number), before.slice(0, 2)));
  await page.mouse.wheel(0, -400);
  await keys("+");
  await isWhole(false);
  await drag(page, size.map(Number), [before[0] + before[2], before[1] + before[3] / 2], [before[0] + before[2] + 7, before[1]]);
  await page.waitForFunction((wide) => Number(document.querySelector("#stage rect.thick")?.getAttribute("width")) === wide, before[2] + 7, patience);
  await keys("d", "ArrowLeft", "Shift+ArrowDown", "Control+ArrowRight", "ArrowRight", "ArrowRight", "0");
  await isWhole(true);
  await keys("End", "Home");
  await page.waitForFunction((right) => Number(document.querySelector("#stage rect.thick")?.getAttribute("x")) === right, before[0] + 1, patience);
  const after = await box();
  console.log("changed", JSON.stringify(after.map((side, place) => side - before[place])));
  await keys("u", "u");
  await page.waitForFunction((wide) => Number(document.querySelector("#stage rect.thick")?.getAttribute("width")) === wide, before[2], patience);

  const fingers = await touchOn(page, browser);
  await fingers("touchStart", [0.3, 0.3]);
  await fingers("touchMove", [0.4, 0.4]);
  await fingers("touchStart", [0.4, 0.4], [0.6, 0.6]);
  await fingers("touchMove", [0.3, 0.3], [0.7, 0.7]);
  await fingers("touchEnd", [0.3, 0.3]);
  await fingers("touchMove", [0.5, 0.3]);
  await fingers("touchEnd");
  console.log("objects", (await page.locator("#timelines b").allInnerTexts()).join());

  await page.evaluate(axe);
  for (const colorScheme of ["light", "dark"]) {
    await page.emulateMedia({ colorScheme });
    console.log("violations", colorScheme, JSON.stringify(await violationsOf(page)));
  }
  for (const [wide, high] of [[390, 844], [1920, 1080]]) {
    await page.setViewportSize({ width: wide, height: high });
    console.log("overflow", await page.evaluate(() => document.documentElement.scrollWidth - innerWidth));
  }
  const other = await browser.newPage();
  await other.goto(url);
  await other.waitForFunction(() => document.querySelector("#overlay").textContent === "", null, patience);
  await page.locator("#timelines button").last().click();
  await page.fill("#name", "carl");
  await keys("Control+Enter");
  await says("#overlay", "Done: the results are written");
  await other.waitForFunction(() => document.querySelector("#overlay").textContent.includes("does not answer"), null, patience);
  console.log("errors", JSON.stringify(wrong.filter((line) => !/40[04]|ERR_/.test(line))));
});
