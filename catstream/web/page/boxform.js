// Asks what a drawn box is: a new object with a name, the chosen one, or another one in its place.

const $ = (selector) => document.querySelector(selector);

export class BoxForm {
  constructor(objects) {
    this.objects = objects;
    [this.role, this.name] = [$("#role"), $("#name")];
    this.role.onchange = () => this.showName();
  }

  /** Show the form with a name for a new object. */
  begin() {
    const first = !this.objects.list.length;
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
    this.name.parentElement.hidden = this.role.value !== "new";
  }

  /** What is wrong with the name of a new object; empty if nothing is. */
  get error() {
    const name = this.name.value.trim();
    if (this.role.value !== "new" || !this.objects.list.length) return "";
    if (!name) return "Give the new object a name.";
    return this.objects.get(name) ? `There is an object ${name} already: give another name.` : "";
  }

  /** The fields of the command. */
  get fields() {
    const role = this.role.value;
    return { object: role === "new" ? this.name.value.trim() : this.objects.chosen, keep: role === "keep" };
  }
}
