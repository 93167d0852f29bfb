// What a person does on the page, in a real browser; says what was seen, a line each.
//   node page.mjs URL CHROMIUM PROFILE BOX WIDTH, then on standard input: "restart" once the pipeline is another

import { createInterface } from "node:readline";
import { errorsOf, patience, placeOf, withBrowser } from "./browser.mjs";

const [url, executablePath, profile, box] = process.argv.slice(2);
const [left, top, wide, tall] = box.split(",").map(Number);

await withBrowser(executablePath, profile, async (browser) => {
  const page = await browser.newPage();
  await page.setViewportSize({ width: 800, height: 600 });
  const wrong = errorsOf(page);
  await page.goto(url);
  const state = page.locator("#state");
  const is = (name) => page.waitForSelector(`#state[data-state="${name}"]`, patience);

  await page.waitForFunction(() => document.querySelector("#overlay").textContent === "", null, patience);
  await page.locator("#state", { hasNotText: "starting" }).waitFor(patience); // the picture may be there before the state
  console.log("state", await state.innerText());
  const draw = async (left, top, wide, tall) => {
    const view = await placeOf(page, "#picture");
    const scale = view.width / Number(process.argv[6]);
    const at = (x, y) => [view.x + x * scale, view.y + y * scale];
    await page.mouse.move(...at(left, top));
    await page.mouse.down();
    await page.mouse.move(...at(left + wide / 2, top + tall / 2));
    await page.mouse.move(...at(left + wide, top + tall));
    await page.mouse.up();
  };
  const click = (selector) => page.click(selector, patience);
  const name = async (text) => {
    await page.press("#name", "Control+A");
    await page.keyboard.type(text);
    await page.keyboard.press("Enter");
  };
  await draw(left, top, wide, tall);
  await click("#follow:not([disabled])");
  await is("present");
  console.log("state", await state.innerText());

  const pausing = () => page.waitForFunction(() => document.querySelector("#message").textContent === "Paused for your box.", null, patience);
  await click("#draw"); // a second object, of which only the name is of interest
  await pausing();
  console.log("paused"); // until the box is set
  await draw(20, 150, 60, 60);
  await page.waitForSelector("#follow:not([disabled])", patience);
  await name("no name");
  await page.waitForSelector("#message.wrong", patience);
  console.log("refused", await page.locator("#message").innerText());
  await name("object-2");
  await page.waitForSelector('.choose[aria-pressed="true"]:has-text("object-2")', patience);
  console.log("objects", (await page.locator(".objects b").allInnerTexts()).join());
  page.once("dialog", (dialog) => dialog.accept());
  await click('[aria-label="Forget object-2"]');
  await page.waitForSelector("#objects", { state: "hidden", ...patience });
  console.log("forgotten", (await page.locator("#message").innerText()).replace(/\d+$/, "N"));
  await page.waitForSelector("#message:empty", { state: "attached", ...patience });
  await click("#draw");
  await pausing();
  await page.reload(); // ends the drawing, and the pause

  await is("absent");
  console.log("state", await state.innerText());
  await page.waitForSelector(".tree circle", { state: "attached", ...patience });

  console.log("trees");
  await is("ended");
  console.log("state", await state.innerText());
  for await (const line of createInterface({ input: process.stdin })) if (line === "restart") break;
  await is("present");
  console.log("state", await state.innerText());
  await page.setViewportSize({ width: 360, height: 740 });
  console.log("overflow", await page.evaluate(() => document.documentElement.scrollWidth - innerWidth));
  console.log("errors", JSON.stringify(wrong.filter((text) => !/40[04]/.test(text))));
});
