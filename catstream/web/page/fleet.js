// The page of a fleet: a wall of the streams, each with a picture and a link to its page, and a table of the nodes. Streams
// with trouble come first. Once a second, it requests the state of the fleet, and the visible pictures.

import { $, add, duration, Items, many, write } from "./dom.js";

const TONES = { running: "present", starting: "bootstrapping", waiting: "bootstrapping", moving: "bootstrapping",
  stopping: "bootstrapping", failed: "absent", lost: "absent", alive: "present", dead: "absent" };
const WORDS = { waiting: "waiting for a box", lost: "source lost" };
const byNumber = new Intl.Collator("en", { numeric: true }).compare; // cam-9 before cam-10

const wall = new Items($(".wall"), { make: makeStream, fill: fillStream });
const nodes = new Items($("#nodes tbody"), { make: makeNode, fill: fillNode });
let fleet = { name: "", problem: "", age: null, streams: [], nodes: [] }; // the last answer
let answered = Date.now(); // its arrival time

async function update() {
  let silent = false;
  try {
    const answer = await fetch("status", { signal: AbortSignal.timeout(5000) });
    if (answer.status === 401) return location.reload();
    fleet = await answer.json();
    answered = Date.now();
  } catch {
    silent = true;
  }
  const current = !silent && !fleet.problem;
  $("#streams").classList.toggle("old", !current);
  show(silent, current);
  if (current) showPictures();
}

/** Show the last answer, and the reason if it is not current. */
function show(silent, current) {
  const trouble = fleet.streams.filter(level).length, running = fleet.streams.filter((one) => one.state === "running").length;
  wall.show(inOrder(fleet.streams));
  nodes.show(inOrder(fleet.nodes));
  $("#fleet").hidden = fleet.age === null;
  $("#nodes").hidden = !fleet.nodes.length;
  write($(".none"), fleet.streams.length ? "" : "This fleet has no streams. Add some to its file, and apply it with “catstream fleet up”.");
  const state = silent ? ["silent", "page stopped"] : fleet.problem ? ["silent", fleet.age === null ? "waiting" : "fleet silent"]
    : trouble ? ["absent", `${trouble} in trouble`] : [running ? "present" : "waiting", `${running} of ${fleet.streams.length} running`];
  $("#state").dataset.state = state[0];
  write($("#state b"), state[1]);
  write($("#source"), fleet.name && `fleet ${fleet.name}`);
  document.title = [trouble && current ? `(${trouble})` : "", fleet.name && `${fleet.name} –`, "catstream"].filter(Boolean).join(" ");
  const age = fleet.age === null ? "" : ` This page shows the state of ${duration(fleet.age + Math.round((Date.now() - answered) / 1000))} ago.`;
  write($("#silence"), silent ? `The server of this page does not answer.${age}` : !fleet.problem ? ""
    : fleet.age === null ? `Waiting for the fleet: ${fleet.problem}` : `The fleet does not answer.${age} The reason: ${fleet.problem}`);
  $("#silence").hidden = current;
}

/** Request the visible pictures; a stream's next picture only after the previous one. */
function showPictures() {
  for (const { name, state } of fleet.streams) {
    const { element, picture } = wall.items.get(name), { top, bottom, height } = element.getBoundingClientRect();
    if (state === "running" && picture.complete && height && bottom > 0 && top < innerHeight) {
      picture.src = `streams/${encodeURIComponent(name)}/picture.jpg?${Date.now()}`;
    }
  }
}

/** Level of trouble: 2 if it does not run, 1 if it runs with a problem, 0 without a problem. */
function level({ state, trouble }) {
  return ["failed", "dead"].includes(state) ? 2 : trouble ? 1 : 0;
}

/** Pairs of name and value, trouble first, then by name. */
function inOrder(values) {
  return values.map((one) => [one.name, one]).sort(([name, one], [other, two]) => level(two) - level(one) || byNumber(name, other));
}

function makePill(parent) {
  const pill = add(parent, "span", { className: "pill" });
  add(pill, "span", { ariaHidden: "true" });
  return { pill, word: add(pill, "b") };
}

function fillPill({ pill, word }, state, words = WORDS[state] ?? state) {
  pill.dataset.state = TONES[state] ?? state;
  write(word, words);
}

/** A tile of the wall: picture, name, state, objects, trouble and figures. */
function makeStream(name) {
  const element = document.createElement("li");
  add(element, "a", { href: `streams/${encodeURIComponent(name)}/`, textContent: name });
  const frame = add(element, "div", { className: "shot" }), picture = add(frame, "img", { alt: "" });
  picture.onload = () => picture.classList.add("there");
  picture.onerror = () => picture.classList.remove("there");
  const objects = new Items(add(element, "ul", { className: "bar" }), {
    make: () => { const item = document.createElement("li"); return { element: item, ...makePill(item) }; },
    fill: (item, [object, here]) => fillPill(item, here ? "present" : "absent", `${object && `${object} `}${here ? "present" : "absent"}`),
  });
  return { element, picture, ...makePill(element), objects, trouble: add(element, "p", { className: "trouble" }),
    about: add(element, "p", { className: "quiet number" }) };
}

function fillStream(item, one) {
  item.element.title = one.source;
  fillPill(item, one.state);
  item.element.classList.toggle("wrong", level(one) > 0);
  item.picture.hidden = one.state !== "running";
  item.objects.show(Object.entries(one.present).map((pair) => [pair[0], pair]));
  write(item.trouble, one.trouble);
  write(item.about, [one.node, `frame ${one.frame.toLocaleString("en")}`, one.skipped && `${many(one.skipped, "frame")} skipped`].filter(Boolean).join(" · "));
}

function makeNode(name) {
  const element = document.createElement("tr"), first = add(element, "td", { textContent: name });
  return { element, labels: add(first, "p", { className: "quiet" }), ...makePill(add(element, "td")),
    used: add(element, "td", { className: "number" }), streams: add(element, "td", { className: "number" }) };
}

function fillNode(item, one) {
  write(item.labels, Object.entries(one.labels).map(([name, value]) => `${name}=${value}`).sort().join(" · "));
  fillPill(item, one.state);
  write(item.used, `${Number(one.used.toFixed(2))} of ${Number(one.cores.toFixed(2))}`);
  write(item.streams, String(one.streams));
}

async function repeat() {
  if (!document.hidden) await update();
  setTimeout(repeat, 1000);
}

repeat();
