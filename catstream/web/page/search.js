// The search field, and buttons that search for the streams in a state. The search is kept in the address of the page.

import { Items, write } from "./dom.js";

const STATES = ["trouble", "failed", "running", "waiting", "paused", "starting", "moving", "stopping", "ended"];

export class Search {
  /** changed() is called whenever another search is made. */
  constructor(field, buttons, changed) {
    Object.assign(this, { field, changed });
    this.buttons = new Items(buttons, { make: (state) => this.make(state), fill: fillButton });
    field.value = new URLSearchParams(location.search).get("search") ?? "";
    field.addEventListener("input", () => this.tell());
    field.addEventListener("keydown", (event) => event.key === "Escape" && this.ask(""));
    document.addEventListener("keydown", (event) => {
      if (event.key !== "/" || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input")) return;
      event.preventDefault();
      field.focus();
    });
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

  /** Whether all words are found in the words of a card, those with an = as whole words. */
  matches(card) {
    return this.words.every((word) => (word.includes("=") ? ` ${card.words} `.includes(` ${word} `) : card.words.includes(word)));
  }

  /** Show a button for each state that streams are in, how many there are, and whether they are searched for. */
  offer(cards) {
    const counts = STATES.map((state) => [state, cards.filter((card) => (state === "trouble" ? card.level : card.state === state)).length]);
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
