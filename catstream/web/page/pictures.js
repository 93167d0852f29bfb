// Small pictures of the streams whose cards are on the screen, at most some of all streams together each second.

const PER_SECOND = 8;
const AT_ONCE = 4; // requests
const APART = 2000; // milliseconds between two pictures of a stream
const AFTER_AN_ERROR = 5000;

export class Pictures {
  constructor() {
    this.paused = false;
    this.pending = 0;
    this.items = new Map(); // element -> the card: its name, what it shows, its image, and a time before which it is not loaded again
    this.visible = new Set();
    this.observer = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) this.visible[isIntersecting ? "add" : "delete"](target);
    });
    setInterval(() => this.load(), 1000 / PER_SECOND);
  }

  add(item) {
    this.items.set(item.element, Object.assign(item, { after: 0 }));
    this.observer.observe(item.element);
  }

  remove({ element }) {
    this.observer.unobserve(element);
    this.visible.delete(element);
    this.items.delete(element);
  }

  /** Load the picture that has waited longest. */
  async load() {
    if (this.paused || document.hidden || this.pending >= AT_ONCE) return;
    const now = Date.now();
    const due = [...this.visible].map((element) => this.items.get(element)).filter((item) => item.card.picture && item.after <= now);
    const item = due.sort((one, other) => one.after - other.after)[0];
    if (!item) return;
    item.after = now + AFTER_AN_ERROR;
    this.pending += 1;
    try {
      const image = Object.assign(new Image(), { alt: "", src: `streams/${encodeURIComponent(item.name)}/picture.jpg?${now}` });
      await image.decode();
      item.image.parentElement.classList.add("loaded");
      item.image.replaceWith(image);
      item.image = image;
      item.after = Date.now() + APART;
    } catch {
      // there is none yet, or the server does not answer: tried again after a while
    } finally {
      this.pending -= 1;
    }
  }
}
