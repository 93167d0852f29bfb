// The cards of the streams: picture, name, state, figures and trouble of each, with a link to its own page.

import { add, write } from "./dom.js";

const WORDS = { waiting: "waiting for a box" };
const TONES = { running: "present", starting: "bootstrapping", waiting: "bootstrapping", moving: "bootstrapping", failed: "absent", unplaced: "absent" };

export class Streams {
  constructor(element, pictures) {
    Object.assign(this, { element, pictures, items: new Map() });
  }

  get size() {
    return this.items.size;
  }

  get cards() {
    return [...this.items.values()].map((item) => item.card);
  }

  count(condition) {
    return this.cards.filter(condition).length;
  }

  /** Take the changed fields of cards, null for one that is gone; all others are gone, too, if the update is complete. */
  update(changes, complete) {
    for (const name of this.items.keys()) if (changes[name] === null || (complete && !(name in changes))) this.remove(name);
    for (const [name, change] of Object.entries(changes)) {
      if (change === null) continue;
      const item = this.items.get(name) ?? this.add(name);
      Object.assign(item.card, change);
      fill(item);
    }
  }

  /** Move the cards into this order; only cards whose place has changed are moved. */
  sort(names) {
    let next = this.element.firstElementChild;
    for (const { element } of names.map((name) => this.items.get(name)).filter(Boolean)) {
      if (element === next) next = next.nextElementSibling;
      else this.element.insertBefore(element, next);
    }
  }

  /** Show the cards that fulfil a condition; returns their number. */
  filter(condition) {
    let shown = 0;
    for (const { element, card } of this.items.values()) {
      const matches = condition(card);
      if (element.hidden === matches) element.hidden = !matches;
      shown += matches;
    }
    return shown;
  }

  add(name) {
    const element = document.createElement("li");
    const image = add(add(element, "div", { className: "picture" }), "img", { alt: "" });
    const link = add(add(element, "h3"), "a", { href: `streams/${encodeURIComponent(name)}/`, textContent: name });
    const state = add(element, "p", { className: "pill" });
    add(state, "span", { ariaHidden: "true" });
    const item = { element, image, link, state, word: add(state, "b"), card: {}, lines: {} };
    for (const className of ["trouble", "where", "models", "store"]) item.lines[className] = add(element, "p", { className });
    this.items.set(name, item);
    this.pictures.add(name, item);
    return item;
  }

  remove(name) {
    const item = this.items.get(name);
    this.pictures.remove(name, item);
    item.element.remove();
    this.items.delete(name);
  }
}

function fill({ element, link, state, word, card, lines }) {
  element.dataset.state = card.state;
  element.classList.toggle("troubled", card.level > 0);
  element.classList.toggle("still", !card.picture);
  state.dataset.state = TONES[card.state] ?? card.state;
  write(word, WORDS[card.state] ?? card.state);
  link.title = card.source;
  write(lines.trouble, card.trouble);
  lines.trouble.title = card.trouble;
  const rate = ["running", "waiting", "moving"].includes(card.state) && `${card.rate} frames/s`;
  write(lines.where, join(card.node || "on no node", rate));
  write(lines.models, card.models.map(([name, version]) => `${name ? `${name}: ` : ""}model ${version}`).join(", ") || "no model yet");
  lines.models.title = lines.models.textContent;
  write(lines.store, join(stored(card.stored), card.restarts && many(card.restarts, "restart"), card.skipped && `${card.skipped.toLocaleString("en")} skipped`,
    card.lost[0] && `${many(card.lost[0], "frame")} (${card.lost[1]} s) lost`));
}

function join(...parts) {
  return parts.filter(Boolean).join(" · ");
}

function many(count, noun) {
  return `${count.toLocaleString("en")} ${noun}${count === 1 ? "" : "s"}`;
}

/** The age of the state in the store, of which the server tells a limit that it is below, in seconds. */
function stored(limit) {
  if (limit === null) return "nothing stored";
  if (limit <= 60) return `stored < ${limit} s ago`;
  return limit < 7200 ? `stored ${limit / 60 - 1} min ago` : `stored ${Math.floor(limit / 3600)} h ago`;
}
