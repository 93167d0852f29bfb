// Small pictures of the streams whose cards are on the screen, at most some of all streams together each second.

const PER_SECOND = 8;
const AT_ONCE = 4; // requests
const APART = 2000; // milliseconds between two pictures of a stream
const AFTER_AN_ERROR = 5000;

export class Pictures {
  constructor() {
    this.items = new Map(); // picture element -> name, card, image, and the time before which it is not asked for again
    this.paused = false;
    this.pending = 0;
    this.visible = new Set();
    this.observer = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) this.visible[isIntersecting ? "add" : "delete"](target);
    });
    setInterval(() => this.load(), 1000 / PER_SECOND);
  }

  add(name, { element, image, card }) {
    this.items.set(element, { name, image, card, after: 0 });
    this.observer.observe(element);
  }

  remove(_, { element, image }) {
    this.observer.unobserve(element);
    this.visible.delete(element);
    this.items.delete(element);
    if (image.src) URL.revokeObjectURL(image.src);
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
      const response = await fetch(`streams/${encodeURIComponent(item.name)}/picture.jpg`);
      if (response.status !== 200) return; // there is none yet
      const before = item.image.src;
      item.image.src = URL.createObjectURL(await response.blob());
      await item.image.decode();
      item.image.parentElement.classList.add("loaded");
      if (before) URL.revokeObjectURL(before);
      item.after = Date.now() + APART;
    } catch {
      // tried again after a while
    } finally {
      this.pending -= 1;
    }
  }
}
