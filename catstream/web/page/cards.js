// The streams of a fleet as cards, and its nodes as the rows of a table; those in trouble first, then by name.

import { add, duration, Items, many, write } from "./dom.js";
import { Pictures } from "./pictures.js";

const TONES = { running: "present", starting: "bootstrapping", waiting: "bootstrapping", moving: "bootstrapping",
  stopping: "bootstrapping", failed: "absent", alive: "present", dead: "absent" };
const WORDS = { waiting: "waiting for a box" };
const WIDE = matchMedia("(min-width: 75rem)");
const byNumber = new Intl.Collator("en", { numeric: true }).compare; // cam-9 before cam-10

/** Pairs of name and value: those that do not run because of trouble, others with trouble, the rest; by name. */
function inOrder(values) {
  for (const value of Object.values(values)) value.level = ["failed", "dead"].includes(value.state) ? 2 : value.trouble ? 1 : 0;
  return Object.entries(values).sort(([name, one], [other, two]) => two.level - one.level || byNumber(name, other));
}

function pill(parent) {
  const element = add(parent, parent.tagName === "LI" ? "p" : "span", { className: "pill" });
  add(element, "span", { ariaHidden: "true" });
  return { element, word: add(element, "b") };
}

function showState({ element, word }, state) {
  element.dataset.state = TONES[state] ?? state;
  write(word, WORDS[state] ?? state);
}

export class Streams {
  constructor(element) {
    this.cards = [];
    this.pictures = new Pictures();
    this.items = new Items(element, { make: (name) => this.make(name), fill: fillCard });
  }

  /** Show all streams; a card is found by its `words`: name, state, node with its labels, and objects. */
  show(streams, nodes) {
    const pairs = inOrder(streams);
    for (const [name, card] of pairs) {
      const objects = card.models.map(([object]) => object);
      card.words = [name, card.state, card.level ? "trouble" : "", `node=${card.node}`, ...(nodes[card.node]?.labels ?? []), ...objects].join(" ").toLowerCase();
    }
    this.cards = pairs.map(([, card]) => card);
    this.items.show(pairs);
  }

  /** Show the cards that fulfil a condition; returns their number. */
  filter(condition) {
    let shown = 0;
    for (const { element, card } of this.items.items.values()) {
      const matches = condition(card);
      element.hidden = !matches;
      shown += matches;
    }
    return shown;
  }

  make(name) {
    const element = document.createElement("li");
    const image = add(add(element, "div", { className: "picture" }), "img", { alt: "" });
    const link = add(add(element, "h3"), "a", { href: `streams/${encodeURIComponent(name)}/`, textContent: name });
    const item = { name, element, image, link, state: pill(element), lines: {} };
    for (const className of ["trouble", "where", "models", "store"]) item.lines[className] = add(element, "p", { className });
    this.pictures.add(item);
    return item;
  }
}

function fillCard(item, card) {
  const { element, link, state, lines } = item;
  item.card = card;
  element.classList.toggle("troubled", card.level > 0);
  element.classList.toggle("still", !card.picture);
  showState(state, card.state);
  link.title = card.source;
  write(lines.trouble, card.trouble);
  lines.trouble.title = card.trouble;
  write(lines.where, join(card.node || "on no node", card.frame && `frame ${card.frame.toLocaleString("en")}`));
  write(lines.models, card.models.map(([name, version]) => `${name ? `${name}: ` : ""}model ${version}`).join(", ") || "no model yet");
  lines.models.title = lines.models.textContent;
  write(lines.store, join(stored(card.stored_seconds), card.skipped && `${card.skipped.toLocaleString("en")} skipped`));
}

export class Nodes {
  /** search(text) is called if the name of a node is pressed. */
  constructor(element, search) {
    this.search = search;
    this.rows = {};
    this.summary = element.querySelector("summary span");
    this.table = element.querySelector(".scrolled");
    this.items = new Items(element.querySelector("tbody"), { make: (name) => this.make(name), fill: fillRow });
    const details = element.querySelector("details");
    details.open = WIDE.matches;
    WIDE.addEventListener("change", () => (details.open = WIDE.matches));
  }

  /** Show all nodes, how many are alive, and how many of their cores are used. */
  show(nodes) {
    this.rows = nodes;
    const rows = Object.values(nodes), alive = rows.filter((row) => row.state !== "dead");
    const total = (field) => round(alive.reduce((sum, row) => sum + row[field], 0));
    const states = alive.length === rows.length ? `${rows.length}` : `${alive.length} of ${rows.length} alive`;
    this.table.hidden = !rows.length;
    write(this.summary, rows.length ? `${states} · ${total("used")} of ${total("cores")} cores used` : "none");
    this.items.show(inOrder(nodes));
  }

  make(name) {
    const element = document.createElement("tr");
    const [node, cores, streams] = ["node", "number", "number"].map((className) => add(element, "td", { className }));
    const button = add(node, "button", { type: "button", textContent: name, onclick: () => this.search(`node=${name}`) });
    return { element, button, state: pill(node), streams, labels: add(node, "p", { className: "quiet labels" }),
      trouble: add(node, "p", { className: "trouble" }), used: add(cores, "span"), bar: add(add(cores, "span", { className: "share" }), "i") };
  }
}

function fillRow({ element, button, state, labels, trouble, used, bar, streams }, row) {
  element.dataset.state = row.state;
  showState(state, row.state);
  write(labels, row.labels.join(" · "));
  button.title = `Show the streams of this node${row.address && `, at ${row.address}`}`;
  write(used, row.state === "dead" ? "–" : `${round(row.used)} of ${round(row.cores)}`);
  bar.style.width = `${row.state === "dead" || !row.cores ? 0 : Math.min(100, (100 * row.used) / row.cores)}%`;
  bar.classList.toggle("full", row.used > row.cores);
  write(streams, String(row.streams));
}

const round = (value, digits = 2) => String(Number(value.toFixed(digits)));
const join = (...parts) => parts.filter(Boolean).join(" · ");

/** The age of the state in the store; it changes only when it passes a limit. */
function stored(seconds) {
  if (seconds === null) return "nothing stored";
  const limit = [5, 10, 15, 30, 60].find((each) => seconds < each);
  return limit ? `stored < ${limit} s ago` : `stored ${duration(Math.floor(seconds / 60) * 60)} ago`;
}
