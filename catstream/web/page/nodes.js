// The table of the nodes: state, cores, labels, streams and trouble of each. The name of a node searches for its streams.

import { add, arrange, write } from "./dom.js";

const TONES = { alive: "present", dead: "absent" };
const WIDE = matchMedia("(min-width: 75rem)");

export class Nodes {
  /** search(name) is called if the name of a node is pressed. */
  constructor(element, search) {
    Object.assign(this, { search, items: new Map() });
    this.body = element.querySelector("tbody");
    this.summary = element.querySelector("summary span");
    this.details = element.querySelector("details");
    this.table = element.querySelector(".scrolled");
    this.details.open = WIDE.matches;
    WIDE.addEventListener("change", () => (this.details.open = WIDE.matches));
  }

  /** Take the changed fields of rows, null for one that is gone; all others are gone, too, if the update is complete. */
  update(changes, complete) {
    for (const [name, item] of this.items) {
      if (changes[name] !== null && !(complete && !(name in changes))) continue;
      item.element.remove();
      this.items.delete(name);
    }
    for (const [name, change] of Object.entries(changes)) {
      if (change === null) continue;
      const item = this.items.get(name) ?? this.add(name);
      Object.assign(item.row, change);
      fill(item);
    }
    this.sort();
    this.sum();
  }

  add(name) {
    const element = document.createElement("tr");
    const [node, cores, streams] = ["node", "number", "number"].map((className) => add(element, "td", { className }));
    const button = add(node, "button", { type: "button", textContent: name, onclick: () => this.search(name) });
    const state = add(node, "span", { className: "pill" });
    add(state, "span", { ariaHidden: "true" });
    const item = { element, row: {}, name, button, state, streams, word: add(state, "b"),
      labels: add(node, "p", { className: "quiet labels" }), trouble: add(node, "p", { className: "trouble" }),
      used: add(cores, "span"), bar: add(add(cores, "span", { className: "share" }), "i") };
    this.items.set(name, item);
    return item;
  }

  /** Dead nodes and those with trouble first, then by name. */
  sort() {
    const level = ({ row }) => (row.state === "dead" ? 2 : row.trouble ? 1 : 0);
    const items = [...this.items.values()].sort((one, other) => level(other) - level(one) || one.name.localeCompare(other.name, "en", { numeric: true }));
    arrange(this.body, items.map((item) => item.element));
  }

  /** Show how many nodes are alive, and how many cores of all nodes are used. */
  sum() {
    const rows = [...this.items.values()].map((item) => item.row);
    const alive = rows.filter((row) => row.state !== "dead");
    const total = (field) => alive.reduce((sum, row) => sum + row[field], 0);
    const states = alive.length === rows.length ? `${rows.length}` : `${alive.length} of ${rows.length} alive`;
    this.table.hidden = !rows.length;
    this.summary.textContent = rows.length ? `${states} · ${round(total("used"))} of ${round(total("cores"))} cores used` : "none";
  }
}

function fill({ element, row, button, state, word, labels, trouble, used, bar, streams }) {
  element.dataset.state = row.state;
  state.dataset.state = TONES[row.state] ?? row.state;
  write(word, row.state);
  write(labels, row.labels.join(" · "));
  button.title = `Show the streams of this node${row.address && `, at ${row.address}`}`;
  write(trouble, row.trouble);
  write(used, row.state === "dead" ? "–" : `${round(row.used)} of ${round(row.cores)}`);
  bar.style.width = `${row.state === "dead" || !row.cores ? 0 : Math.min(100, (100 * row.used) / row.cores)}%`;
  bar.classList.toggle("full", row.used > row.cores);
  write(streams, String(row.streams));
}

function round(cores) {
  return String(Math.round(cores * 100) / 100);
}
