// The page in each of its states, light and dark: what axe finds wrong with it, and what it says, as JSON.
//   node states.mjs URL CHROMIUM PROFILE PICTURE [SCREENSHOTS]; the stream of events is a stand-in, the rest is the page

import { axe, placeOf, violationsOf, withBrowser } from "./browser.mjs";

const [url, executablePath, profile, picture, screenshots] = process.argv.slice(2);
const DESKTOP = { width: 1200, height: 900 }, PHONE = { width: 390, height: 844 };
const PAGES = process.env.EVERY_SIZE
  ? [["light", DESKTOP], ["dark", PHONE], ["light", PHONE], ["dark", DESKTOP]] : [["light", DESKTOP], ["dark", PHONE]];

const status = {
  phase: "running", reason: "", endpoint: "/tmp/catstream-a1", source: "/videos/walk.mp4",
  state: "running", words: "running", paused: false, skipped: null,
};
const anna = { name: "anna", colour: "#ff922b", state: "present", score: 0.93, version: 12 };
const ben = { name: "constructor", colour: "#3586ff", state: "present", score: 0.61, version: 9 };
const carl = { name: "a-name-that-is-as-long-as-a-name-may-be-which-is-64-characters.64", colour: "#fedd38", state: "absent", score: 0.08, version: 4 };
const tracks = (...objects) => ({ frame: objects.length ? 210 : null, time: 8.4, objects });
const unnamed = (state) => tracks({ ...anna, name: "", state });
const box = [120, 90, 60, 50];
const names = ["", anna.name, ben.name, carl.name];
const byName = (value) => Object.fromEntries(names.map((name) => [name, value]));
const points = [...Array(40).keys()].map((n) => [n / 4, 60 + n, byName([Math.sin(n / 6) / 2 + 0.5, 0.2, Math.floor(n / 4), n < 30])]);
for (const [, , objects] of points.slice(0, 20)) delete objects[ben.name]; // it began later; each object of JavaScript has one of that name
const kinds = [0, 1, 2, 3].map((place) => ({ title: `Tree ${place}`, meaning: "what it summarises" }));
const trees = (...leaves) => ({ kinds, objects: leaves.length ? byName({ leaves, bytes: 4e6, rows: 5120 }) : {} });
const nothing = { tracks: tracks(), picture: null, trees: trees() };
const all = {
  pipeline: 1, status, tracks: unnamed("present"), picture: { frame: 210, width: 320, height: 240, boxes: { "": box } }, points,
  trees: trees(13, 22, 9, 0),
};
const several = { tracks: tracks(anna, ben, carl), picture: { frame: 210, width: 320, height: 240, boxes: { anna: box, [ben.name]: [30, 4, 50, 90] } } };
const paused = { state: "paused", words: "paused", paused: true };
const changed = (more, state = "present") => ({ status: { ...status, ...more }, tracks: unnamed(state) });

//: What the page is told in each state, after it was told all; what is done there; in that order.
const STATES = {
  "no pipeline": { pipeline: 0, status: { ...status, phase: "waiting", state: "none", source: "", endpoint: "", reason: "no pipeline of yours is running" },
    ...nothing },
  "waiting for a box": { ...all, ...changed({ state: "waiting", words: "waiting for a box" }), tracks: tracks() },
  bootstrapping: { ...all, ...changed({}, "bootstrapping") },
  present: { ...all },
  absent: changed({}, "absent"),
  paused: changed(paused, null),
  lost: changed({ state: "lost", words: "source lost for 12 s", skipped: 40 }, null),
  "lost, of several": { tracks: tracks(...[anna, ben].map((one) => ({ ...one, state: null, score: null }))) },
  silent: changed({ phase: "silent" }),
  "another pipeline": { pipeline: 2, status: { ...status, source: "rtsp://10.0.0.7/stream1", endpoint: "run" }, ...nothing },
  "three objects": { ...all, ...several },
  "another one chosen": {},
  "drawing one more": {},
  forgetting: {},
  forgotten: {},
  "two objects": { tracks: tracks(anna, carl) },
  drawing: { ...all },
  "drawing the next one while the answer comes": {},
  "cancelled, begun and cancelled": {},
  "cancelled during a pause": changed(paused),
  "the end": changed({ phase: "ended", reason: "the source has ended" }),
  "the end, and of the server": { closed: true },
};
const draw = async (page, viewport) => {
  await page.waitForFunction(() => document.querySelector("#overlay").textContent === "");
  const view = await placeOf(page, "#picture");
  const at = (part) => ({ x: view.x + view.width * part, y: view.y + view.height * part });
  if (viewport === PHONE) { // with a finger
    const touch = await page.context().newCDPSession(page);
    for (const [type, ...points] of [["touchStart", at(0.3)], ["touchMove", at(0.4)], ["touchMove", at(0.6)], ["touchEnd"]]) {
      await touch.send("Input.dispatchTouchEvent", { type, touchPoints: points });
    }
  } else {
    await page.mouse.move(at(0.3).x, at(0.3).y);
    await page.mouse.down();
    await page.mouse.move(at(0.6).x, at(0.6).y);
    await page.mouse.up();
  }
  await page.waitForSelector("#follow:not([disabled])");
};
const pausing = (page) => page.waitForFunction(() => document.querySelector("#message").textContent === "Paused for your box.");
const forget = (page, answer) => {
  page.once("dialog", (dialog) => dialog[answer]());
  return page.click(`[aria-label="Forget ${ben.name}"]`);
};
let answered = null; // what the answer to a command waits for
const doing = {
  drawing: draw,
  "another one chosen": (page) => page.click(`.choose:has-text("${ben.name}")`),
  "drawing one more": draw,
  forgetting: async (page) => {
    await page.press("#name", "Control+A");
    await page.keyboard.type("dora");
    await page.keyboard.press("Escape");
    await forget(page, "dismiss");
  },
  forgotten: (page) => Promise.all([page.waitForRequest("**/control"), forget(page, "accept")]),
  "drawing the next one while the answer comes": async (page) => {
    let answer;
    answered = new Promise((resolve) => { answer = resolve; });
    const { x, y } = await placeOf(page, "#picture");
    await page.click("#follow");
    await page.mouse.move(x + 20, y + 20);
    await page.mouse.down();
    await page.mouse.move(x + 60, y + 60);
    answer();
    await page.waitForSelector("#drawing", { state: "hidden" });
    await page.mouse.move(x + 90, y + 90);
    await page.mouse.up();
    await page.waitForSelector("#follow:not([disabled])");
  },
  "cancelled, begun and cancelled": async (page) => {
    let answer;
    answered = new Promise((resolve) => { answer = resolve; });
    for (const key of ["Escape", "Enter"]) await page.press("#stage", key);
    answer();
    await pausing(page);
    await page.press("#stage", "Escape");
  },
  "cancelled during a pause": async (page) => {
    await page.press("#stage", "Enter");
    await pausing(page);
    await page.press("#stage", "Escape");
  },
  "the end, and of the server": (page) => page.evaluate(() => events.onerror()),
};

const colours = (lines) => [...new Set(lines.map((line) => getComputedStyle(line).stroke))];

const seen = [];
await withBrowser(executablePath, profile, async (browser) => {
  for (const [scheme, viewport] of PAGES) {
    const page = await browser.newPage();
    await page.setViewportSize(viewport);
    if (viewport === PHONE) { // has no pointer that hovers
      const phone = await page.context().newCDPSession(page);
      await phone.send("Emulation.setDeviceMetricsOverride", { ...viewport, deviceScaleFactor: 1, mobile: true });
      await phone.send("Emulation.setTouchEmulationEnabled", { enabled: true });
    }
    await page.emulateMedia({ colorScheme: scheme, reducedMotion: "reduce" });
    await page.addInitScript(() => {
      window.EventSource = class { constructor() { window.events = this; } close() {} };
    });
    let loaded = 0; // pictures
    await page.route("**/pictures/*", (route) => {
      loaded += 1;
      return route.fulfill({ path: picture, contentType: "image/jpeg" });
    });
    const sent = []; // commands
    await page.route("**/control", async (route) => {
      sent.push(route.request().postDataJSON());
      await answered;
      return route.fulfill({ json: { done: true, reason: "paused after frame 210", frame: 210, version: 12, object: "" } });
    });
    await page.goto(url);
    await page.evaluate(axe);
    for (const [name, parts] of Object.entries(STATES)) {
      await page.evaluate((told) => events.onmessage({ data: JSON.stringify(told) }), parts);
      await doing[name]?.(page, viewport);
      seen.push({ state: name, scheme, pill: await page.locator("#state").innerText(), overlay: await page.locator("#overlay").textContent(),
        source: await page.locator("#source").textContent(), frame: await page.locator("#frame").textContent(),
        objects: await page.locator(".objects b").allTextContents(), scores: await page.locator(".objects .score").allTextContents(), chosen: await page.locator('.choose[aria-pressed="true"] b').allTextContents(),
        charts: await page.locator("#charts-title").innerText(), name: await page.locator("#name").inputValue(), sent: sent.at(-1) ?? null,
        message: await page.locator("#message").textContent(), loud: await page.locator("#watching .main").allInnerTexts(), role: await page.locator("#role").inputValue(),
        header: await page.locator("header").innerText(), keys: await page.locator(".keys").isVisible(),
        folded: !(await page.locator(".trees").isVisible()), lines: await page.locator("polyline").evaluateAll(colours),
        trees: await page.locator(".tree figcaption b").allTextContents(),
        wide: await page.evaluate(() => document.documentElement.scrollWidth - innerWidth),
        violations: await violationsOf(page), loaded });
      if (screenshots) await page.screenshot({ path: `${screenshots}/${name}-${scheme}-${viewport.width}.png`, fullPage: ["present", "three objects"].includes(name) });
    }
    await page.close();
  }
  console.log(JSON.stringify(seen));
});
