// The search field, and the buttons that select the streams in a state. Both are kept in the address of the page.

import { arrange, write } from "./dom.js";

const STATES = ["failed", "unplaced", "running", "waiting", "paused", "starting", "moving", "ended"];

export class Search {
  /** changed() is called whenever another search is made. */
  constructor(field, buttons, changed) {
    Object.assign(this, { field, buttons, changed, made: new Map() });
    const address = new URLSearchParams(location.search);
    field.value = address.get("search") ?? "";
    this.state = address.get("state") ?? "";
    field.addEventListener("input", () => this.tell());
    field.addEventListener("keydown", (event) => event.key === "Escape" && this.ask(""));
    document.addEventListener("keydown", (event) => {
      if (event.key !== "/" || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input")) return;
      event.preventDefault();
      field.focus();
    });
  }

  /** Search for a text, in any state. */
  ask(text) {
    this.field.value = text;
    this.state = "";
    this.tell();
  }

  choose(state) {
    this.state = this.state === state ? "" : state;
    this.tell();
  }

  tell() {
    const address = new URLSearchParams(Object.entries({ search: this.field.value.trim(), state: this.state }).filter(([, value]) => value));
    history.replaceState(null, "", address.size ? `?${address}` : location.pathname);
    for (const [state, button] of this.made) button.setAttribute("aria-pressed", String(state === this.state));
    this.changed();
  }

  get words() {
    return this.field.value.toLowerCase().split(/\s+/).filter(Boolean);
  }

  /** Whether a stream is in the chosen state, and all words are in its name, state, node, labels or objects. */
  matches(card) {
    return inState(card, this.state) && this.words.every((word) => card.words.includes(word));
  }

  get description() {
    return [this.field.value.trim() && `“${this.field.value.trim()}”`, this.state && `the state “${this.state}”`].filter(Boolean).join(" and ");
  }

  /** Show a button for each state that streams are in, and how many there are. */
  offer(cards) {
    const counts = new Map(["", "trouble", ...STATES].map((state) => [state, cards.filter((card) => inState(card, state)).length]));
    const offered = [...counts].filter(([state, count]) => count || state === "" || state === this.state);
    const buttons = offered.map(([state, count]) => {
      const button = this.made.get(state) ?? this.make(state);
      const label = `${state === "" ? "all" : state === "trouble" ? "in trouble" : state} ${count}`;
      write(button, label);
      return button;
    });
    arrange(this.buttons, buttons);
  }

  make(state) {
    const button = Object.assign(document.createElement("button"), { type: "button", onclick: () => this.choose(state) });
    button.dataset.state = state;
    button.setAttribute("aria-pressed", String(state === this.state));
    this.made.set(state, button);
    return button;
  }
}

function inState(card, state) {
  return state === "" || (state === "trouble" ? card.level > 0 : card.state === state);
}
