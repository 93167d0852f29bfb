// The list of the objects, and the form for the role of a drawn box.

import { $, add, Items, write } from "./dom.js";

/** Colour, name, state, score and model of each object, and a button that drops it. */
export class Objects {
  /** actions: choose(name) is called if another object is chosen, forget(name) if the button of an object is pressed. */
  constructor(element, actions) {
    Object.assign(this, { actions, list: [], chosen: null });
    this.items = new Items(element, { make: (name) => this.make(name), fill });
  }

  /** True if there is no choice: without objects, or with a single unnamed object. */
  get single() {
    return this.list.length < 2 && !this.list[0]?.name;
  }

  get(name) {
    return this.list.find((one) => one.name === name);
  }

  /** The first unused name of object-2, object-3 ... */
  get suggestion() {
    for (let number = this.list.length + 1; ; number++) if (!this.get(`object-${number}`)) return `object-${number}`;
  }

  /** Show a list of objects. If the chosen object is not in it, choose the requested or the first one. */
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
  element.dataset.state = one.state ?? "";
  share.style.width = `${100 * Math.max(0, Math.min(1, one.score ?? 0))}%`;
  write(state, one.state ?? "–"); // unknown while no frames are tracked
  write(model, `, model ${one.version}`);
  write(score, one.score?.toFixed(2) ?? "–");
}

/** Asks for the role of a drawn box: a new object with a name, the chosen object, or a replacement for it. */
export class BoxForm {
  /** actions: accept() and cancel() are called if the user confirms or cancels. */
  constructor(objects, { accept, cancel }) {
    this.objects = objects;
    [this.form, this.role, this.name] = [$("#drawing"), $("#role"), $("#name")];
    this.role.onchange = () => this.showName();
    this.form.onsubmit = (event) => { event.preventDefault(); accept(); };
    this.form.onkeydown = ({ key }) => { if (key === "Escape") cancel(); }; // false would prevent the typing of a name
    $("#cancel").onclick = cancel;
  }

  /** Show the form with a name for a new object. */
  begin() {
    const first = !this.objects.list.length;
    this.name.required = !first;
    this.name.value = first ? "" : this.objects.suggestion;
    this.name.placeholder = first ? "optional" : "";
    this.offer("new");
  }

  /** Offer the possible roles for the chosen object; the first object is always new. */
  offer(role = this.role.value) {
    const { single, chosen, list } = this.objects;
    const roles = Object.entries({
      new: single ? "one more object" : "a new object",
      keep: `the same ${chosen || "object"}: keep what was learned`,
      another: chosen ? `another object as ${chosen}` : "another object in its place",
    });
    const options = roles.map(([value, textContent]) => Object.assign(document.createElement("option"), { value, textContent }));
    this.role.replaceChildren(...options.slice(0, list.length ? 3 : 1));
    this.role.value = list.length ? role : "new";
    this.role.parentElement.hidden = !list.length;
    this.showName();
  }

  showName() {
    this.name.disabled = this.name.parentElement.hidden = this.role.value !== "new";
  }

  /** Return true if the name of a new object is unique; otherwise the browser shows the error. */
  check() {
    this.name.value = this.name.value.trim().normalize("NFC");
    const existing = this.objects.get(this.name.value);
    this.name.setCustomValidity(existing?.name ? `There is an object ${existing.name} already: use another name.` : "");
    return this.form.reportValidity();
  }

  /** The fields of the command. */
  get fields() {
    const role = this.role.value;
    return { object: role === "new" ? this.name.value : this.objects.chosen, keep: role === "keep" };
  }
}
