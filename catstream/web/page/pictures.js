// Small pictures of the streams whose cards are on the screen, one after the other.

const AT_ONCE = 4; // requests
const PAUSE = 125; // milliseconds from one look for a picture to the next
const APART = 2000; // milliseconds between two pictures of a stream
const AFTER_AN_ERROR = 5000;

export class Pictures {
  constructor() {
    this.paused = false;
    this.items = new WeakMap(); // element -> the card: its name, what it shows, its image, and a time before which it is not loaded again
    this.visible = new Set(); // elements; one that is removed from the page is no longer visible
    this.observer = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) this.visible[isIntersecting ? "add" : "delete"](target);
    });
    for (let worker = 0; worker < AT_ONCE; worker++) this.load();
  }

  add(item) {
    this.items.set(item.element, Object.assign(item, { after: 0 }));
    this.observer.observe(item.element);
  }

  /** Load, again and again, the picture that has waited longest. */
  async load() {
    for (;; await new Promise((next) => setTimeout(next, PAUSE * AT_ONCE))) {
      const now = Date.now();
      const due = [...this.visible].map((element) => this.items.get(element)).filter((item) => item.card.picture && item.after <= now);
      const item = due.sort((one, other) => one.after - other.after)[0];
      if (!item || this.paused || document.hidden) continue;
      item.after = now + AFTER_AN_ERROR;
      const image = Object.assign(new Image(), { alt: "", src: `streams/${encodeURIComponent(item.name)}/picture.jpg?${now}` });
      if (!(await image.decode().then(() => true, () => false))) continue; // there is none yet, or the server does not answer
      item.image.parentElement.classList.add("loaded");
      item.image.replaceWith(image);
      item.image = image;
      item.after = Date.now() + APART;
    }
  }
}
