// The list of the objects: colour, name, state, score and model of each, one of them chosen, and a button that drops it.

import { add, Items, write } from "./dom.js";

export class Objects {
  /** actions: choose(name) is called if another object is chosen; forget(name) if the button of an object is pressed. */
  constructor(element, actions) {
    Object.assign(this, { actions, list: [], chosen: null });
    this.items = new Items(element, { make: (name) => this.make(name), fill });
  }

  /** Whether there is nothing to choose: no object, or one without a name. */
  get single() {
    return this.list.length < 2 && !this.list[0]?.name;
  }

  get(name) {
    return this.list.find((one) => one.name === name);
  }

  /** The first of object-2, object-3 ... that is no object's name. */
  get suggestion() {
    for (let number = this.list.length + 1; ; number++) if (!this.get(`object-${number}`)) return `object-${number}`;
  }

  /** Show these objects. If the chosen one is not among them, the first one is chosen, or the one to choose next. */
  show(list) {
    this.list = list;
    if (this.next !== undefined && this.get(this.next)) this.choose(this.next);
    else if (!this.get(this.chosen)) this.choose(list[0]?.name ?? null);
    this.draw();
  }

  /** Choose an object, now or as soon as it is shown. */
  choose(name) {
    this.next = name === null || this.get(name) ? undefined : name;
    if (this.next !== undefined || name === this.chosen) return;
    this.chosen = name;
    this.draw();
    this.actions.choose(name);
  }

  draw() {
    this.items.show(this.list.map((one) => [one.name, { ...one, chosen: one.name === this.chosen }]));
  }

  make(name) {
    const element = document.createElement("li");
    const choose = add(element, "button", { type: "button", className: "choose", onclick: () => this.choose(name) });
    add(choose, "i", { className: "swatch" });
    add(choose, "b", { textContent: name || "object without a name" });
    const about = add(choose, "span", { className: "state" });
    const [state, model] = [add(about, "span", {}), add(about, "span", { className: "model" })];
    const score = add(choose, "span", { className: "score number" });
    const share = add(add(choose, "span", { className: "share" }), "i");
    const forget = add(element, "button", { type: "button", className: "forget", textContent: "Forget", onclick: () => this.actions.forget(name) });
    forget.setAttribute("aria-label", `Forget ${name || "the object without a name"}`);
    return { element, choose, state, model, score, share };
  }
}

function fill({ element, choose, state, model, score, share }, one) {
  choose.setAttribute("aria-pressed", String(one.chosen));
  element.style.setProperty("--colour", one.colour);
  element.dataset.state = one.state;
  share.style.width = `${100 * Math.max(0, Math.min(1, one.score))}%`;
  write(state, one.state);
  write(model, `, model ${one.version}`);
  write(score, one.score.toFixed(2));
}
