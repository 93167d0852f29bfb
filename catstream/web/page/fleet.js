// The page of a fleet: a wall of the streams, each with a picture and a link to its page, and a table of the nodes; those
// in trouble first.

import { $, add, duration, Items, many, write } from "./dom.js";

const STATES = ["trouble", "failed", "lost", "running", "waiting", "paused", "starting", "moving", "stopping", "ended"];
const TONES = { running: "present", starting: "bootstrapping", waiting: "bootstrapping", moving: "bootstrapping",
  stopping: "bootstrapping", failed: "absent", lost: "absent", alive: "present", dead: "absent" };
const WORDS = { waiting: "waiting for a box", lost: "source lost" };
const byNumber = new Intl.Collator("en", { numeric: true }).compare; // cam-9 before cam-10
const round = (value) => String(Number(value.toFixed(2)));

export class FleetPage {
  /** server: {closed, silent}, whether it has announced its shutdown, and the time since which it does not answer. */
  constructor(server) {
    this.server = server;
    this.fleet = { phase: "waiting", name: "", reason: "", age: 0 };
    this.streams = []; // pairs of name and value
    this.wall = new Items($("#fleet .wall"), { make: makeStream, fill: fillStream });
    this.nodes = new Items($("#nodes tbody"), { make: (name) => makeNode(name, () => this.search.ask(`node=${name}`)), fill: fillNode });
    this.search = new Search($("#search"), $(".states"), () => this.showMatching());
    $("#streams").hidden = false;
    setInterval(() => this.tick(), 1000);
    this.showState();
  }

  /** Once a second: ask for the pictures that are in view; the next one of a stream only after the one before. */
  tick() {
    if (this.server.silent !== null) this.showState();
    if (document.hidden || $("#streams").classList.contains("old")) return;
    for (const [name, { state }] of this.streams) {
      const { element, picture } = this.wall.items.get(name), { top, bottom, height } = element.getBoundingClientRect();
      if (state === "running" && picture.complete && height && bottom > 0 && top < innerHeight) {
        picture.src = `streams/${encodeURIComponent(name)}/picture.jpg?${Date.now()}`;
      }
    }
  }

  take({ status, streams, nodes }) {
    this.fleet = status ?? this.fleet;
    this.labels = nodes ? Object.fromEntries(Object.entries(nodes).map(([name, node]) => [name, labels(node)])) : this.labels;
    if (nodes) this.showNodes(nodes);
    if (streams) this.showStreams(streams);
    this.showMatching();
    this.showState();
  }

  /** Show all streams; one is found by its `words`: name, state, node with its labels, and objects. */
  showStreams(streams) {
    this.streams = inOrder(streams);
    for (const [name, one] of this.streams) {
      one.words = [name, one.state, one.level ? "trouble" : "", `node=${one.node}`, ...(this.labels?.[one.node] ?? []),
        ...one.models.map(([object]) => object), ...one.present.map(([object, here]) => `${object} ${here ? "present" : "absent"}`)]
        .join(" ").toLowerCase();
    }
    this.wall.show(this.streams);
  }

  /** Show all nodes, how many are alive, and how many of their cores are used. */
  showNodes(nodes) {
    const rows = Object.values(nodes), alive = rows.filter((row) => row.state !== "dead");
    const total = (field) => round(alive.reduce((sum, row) => sum + row[field], 0));
    const states = alive.length === rows.length ? `${rows.length}` : `${alive.length} of ${rows.length} alive`;
    $("#nodes .scrolled").hidden = !rows.length;
    write($("#nodes .count"), rows.length ? `${states} · ${total("used")} of ${total("cores")} cores used` : "none");
    this.nodes.show(inOrder(nodes));
  }

  showMatching() {
    const { search, fleet } = this, values = this.streams.map(([, one]) => one);
    search.offer(values);
    for (const [name, one] of this.streams) this.wall.items.get(name).element.hidden = !search.matches(one);
    const shown = values.filter((one) => search.matches(one)).length;
    $(".find").hidden = !values.length;
    write($(".none"), fleet.phase === "running" && !values.length ? "This fleet has no streams. Add some to its file, and apply it with “catstream fleet up”."
      : values.length && !shown ? `No stream matches “${search.text}”.` : "");
  }

  showState() {
    const { fleet, server: { silent, closed } } = this;
    const current = fleet.phase === "running" && silent === null && !closed;
    const troubled = this.streams.filter(([, one]) => one.level).length;
    const [state, words] = this.state(troubled);
    $("#state").dataset.state = state;
    write($("#state b"), words);
    write($("#source"), fleet.name && `fleet ${fleet.name}`);
    document.title = [troubled && current ? `(${troubled})` : "", fleet.name && `${fleet.name} –`, "catstream"].filter(Boolean).join(" ");
    const message = this.explanation();
    write($("#silence"), message);
    $("#silence").hidden = !message;
    for (const each of document.querySelectorAll("#streams section")) each.hidden = fleet.phase === "waiting";
    $("#streams").classList.toggle("old", !current);
  }

  /** The state of the fleet for its colour, and in words. */
  state(troubled) {
    const { fleet, streams, server: { silent, closed } } = this;
    if (silent !== null || closed) return ["silent", "page stopped"];
    if (fleet.phase !== "running") return [fleet.phase, fleet.phase === "silent" ? "fleet silent" : "waiting"];
    if (troubled) return ["absent", `${troubled} in trouble`];
    const running = streams.filter(([, one]) => one.state === "running").length;
    if (!streams.length) return ["waiting", "no streams"];
    return [running ? "present" : "waiting", `${running === streams.length ? "" : `${running} of `}${streams.length} running`];
  }

  /** Why the page is not current; empty if it is. */
  explanation() {
    const { fleet, server: { silent, closed } } = this;
    const age = fleet.age + (silent === null ? 0 : Math.round((Date.now() - silent) / 1000));
    const shown = fleet.name ? ` It shows the state of ${duration(age)} ago.` : "";
    if (closed) return "The server of this page was stopped. The fleet may still run.";
    if (silent !== null) return `The server of this page does not answer. This page tries again.${shown}`;
    if (fleet.phase === "silent") return `The fleet does not answer.${shown.replace("It", "This page")} The reason: ${fleet.reason}`;
    return fleet.phase === "waiting" && fleet.reason ? `Waiting for the fleet: ${fleet.reason}` : "";
  }
}

/** Pairs of name and value: those that do not run because of trouble, others with trouble, the rest; by name. */
function inOrder(values) {
  for (const value of Object.values(values)) value.level = ["failed", "dead"].includes(value.state) ? 2 : value.trouble ? 1 : 0;
  return Object.entries(values).sort(([name, one], [other, two]) => two.level - one.level || byNumber(name, other));
}

const labels = (node) => Object.entries(node.labels).map(([name, value]) => `${name}=${value}`).sort();

function makePill(parent) {
  const pill = add(parent, "span", { className: "pill" });
  add(pill, "span", { ariaHidden: "true" });
  return { pill, word: add(pill, "b") };
}

function fillPill({ pill, word }, state, words = WORDS[state] ?? state) {
  pill.dataset.state = TONES[state] ?? state;
  write(word, words);
}

/** A tile of the wall: the picture, the name, the state, the objects, what is wrong, and figures. */
function makeStream(name) {
  const element = document.createElement("li");
  const link = add(element, "a", { href: `streams/${encodeURIComponent(name)}/`, textContent: name });
  const frame = add(element, "div", { className: "shot" }), picture = add(frame, "img", { alt: "" });
  picture.onload = () => picture.classList.add("there");
  picture.onerror = () => picture.classList.remove("there");
  const objects = new Items(add(element, "ul", { className: "bar" }), {
    make: () => { const item = document.createElement("li"); return { element: item, ...makePill(item) }; },
    fill: (item, [object, here]) => fillPill(item, here ? "present" : "absent", `${object && `${object} `}${here ? "present" : "absent"}`),
  });
  return { element, link, picture, ...makePill(element), objects, trouble: add(element, "p", { className: "trouble" }),
    about: add(element, "p", { className: "quiet number" }) };
}

function fillStream(item, one) {
  item.link.title = one.source;
  fillPill(item, one.state);
  item.element.classList.toggle("wrong", one.level > 0);
  item.picture.hidden = one.state !== "running";
  item.objects.show(one.present.map((pair) => [pair[0], pair]));
  write(item.trouble, one.trouble);
  const models = one.models.map(([name, version]) => (name ? `${name} ${version}` : version)).join(", ");
  write(item.about, [one.node, `frame ${one.frame.toLocaleString("en")}`, one.skipped && `${many(one.skipped, "frame")} skipped`,
    models && `model ${models}`, stored(one.stored_seconds)].filter(Boolean).join(" · "));
}

function makeNode(name, onclick) {
  const element = document.createElement("tr"), first = add(element, "td");
  const button = add(first, "button", { type: "button", textContent: name, onclick });
  return { element, button, about: add(first, "p", { className: "quiet" }), ...makePill(add(element, "td")),
    used: add(element, "td", { className: "number" }), streams: add(element, "td", { className: "number" }) };
}

function fillNode(item, one) {
  write(item.about, labels(one).join(" · "));
  item.button.title = `Show the streams of this node${one.address && `, at ${one.address}`}`;
  fillPill(item, one.state);
  write(item.used, one.state === "dead" ? "–" : `${round(one.used)} of ${round(one.cores)}`);
  write(item.streams, String(one.streams));
}

/** The age of the state in the store; it changes only when it passes a limit. */
function stored(seconds) {
  if (seconds === null) return "";
  const limit = [5, 10, 15, 30, 60].find((each) => seconds < each);
  return `stored ${limit ? `< ${limit} s ago` : `${duration(Math.floor(seconds / 60) * 60)} ago`}`;
}

/** The search field, and buttons that search for the streams in a state. The search is kept in the address of the page. */
class Search {
  /** changed() is called whenever another search is made. */
  constructor(field, buttons, changed) {
    Object.assign(this, { field, changed });
    this.buttons = new Items(buttons, { make: (state) => this.make(state), fill: fillButton });
    field.value = new URLSearchParams(location.search).get("search") ?? "";
    field.addEventListener("input", () => this.tell());
    field.addEventListener("keydown", (event) => event.key === "Escape" && this.ask(""));
  }

  get text() {
    return this.field.value.trim();
  }

  get words() {
    return this.text.toLowerCase().split(/\s+/).filter(Boolean);
  }

  /** Search for a text. */
  ask(text) {
    this.field.value = text;
    this.tell();
  }

  tell() {
    history.replaceState(null, "", this.text ? `?${new URLSearchParams({ search: this.text })}` : location.pathname);
    this.changed();
  }

  /** Whether all words are found in the words of a stream, those with an = as whole words. */
  matches(stream) {
    return this.words.every((word) => (word.includes("=") ? ` ${stream.words} `.includes(` ${word} `) : stream.words.includes(word)));
  }

  /** Show a button for each state that streams are in, how many there are, and whether they are searched for. */
  offer(streams) {
    const counts = STATES.map((state) => [state, streams.filter((one) => (state === "trouble" ? one.level : one.state === state)).length]);
    const shown = counts.map(([state, count]) => [state, { count, pressed: this.words.includes(state) }]);
    this.buttons.show(shown.filter(([, { count, pressed }]) => count || pressed));
  }

  /** A button that adds its state to the words, in place of another one, or removes it. */
  make(state) {
    const press = () => this.ask([...this.words.filter((word) => !STATES.includes(word)), ...(this.words.includes(state) ? [] : [state])].join(" "));
    const element = Object.assign(document.createElement("button"), { type: "button", onclick: press });
    element.dataset.state = state;
    return { element };
  }
}

function fillButton({ element }, { count, pressed }) {
  const { state } = element.dataset;
  write(element, `${state === "trouble" ? "in trouble" : state} ${count}`);
  element.setAttribute("aria-pressed", String(pressed));
}
