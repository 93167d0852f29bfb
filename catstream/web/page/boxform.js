// Asks what a drawn box is: a new object with a name, the chosen one, or another one in its place.

import { $ } from "./dom.js";

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

  /** Offer the roles that there are for the chosen object. The first object is a new one. */
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

  /** Whether a new object has a name that no other has; if not, the browser says what is wrong. */
  check() {
    this.name.value = this.name.value.trim();
    const taken = this.objects.get(this.name.value);
    this.name.setCustomValidity(taken?.name ? `There is an object ${taken.name} already: give another name.` : "");
    return this.form.reportValidity();
  }

  /** The fields of the command. */
  get fields() {
    const role = this.role.value;
    return { object: role === "new" ? this.name.value : this.objects.chosen, keep: role === "keep" };
  }
}
