// The live picture with the boxes of its objects, and the box that the user draws with mouse, touch or keyboard.

import { make } from "./dom.js";

const STEP = 0.02; // distance of an arrow key, as a share of the picture's shorter side
const SMALLEST = 6; // minimum side of a box in pixels of the frame
const STILL = 4; // pixels of the screen that a pointer may move in a click
const TEXT = 13; // height of a name in pixels of the screen

export class Stage {
  /**
   * objects: the list of the objects. actions: freeze() returns the frame of the box; follow(box, still) sends the box;
   * changed(drawing, box) is called when the drawing changes.
   */
  constructor(element, objects, actions) {
    Object.assign(this, { element, objects, actions });
    this.image = element.querySelector("img");
    this.boxes = element.querySelector("svg"); // over the image, in pixels of the frame
    this.picture = this.box = this.start = this.still = this.pointer = null;
    this.drawing = this.loading = false;
    this.smallest = SMALLEST;
    this.generation = 0; // number of earlier pipelines
    element.addEventListener("pointerdown", (event) => this.press(event));
    element.addEventListener("pointermove", (event) => this.drag(event));
    element.addEventListener("pointerup", (event) => this.release(event));
    element.addEventListener("lostpointercapture", (event) => this.abort(event)); // no effect after a release
    element.addEventListener("keydown", (event) => this.key(event));
  }

  /** Clear the picture, because another pipeline is shown. */
  clear() {
    this.cancel(false);
    this.picture = this.next = null;
    this.generation += 1;
    this.image.removeAttribute("src");
    this.boxes.replaceChildren();
  }

  /** Load and show a picture; while another one is loading, only the newest is loaded next. */
  async show(picture) {
    this.next = picture;
    if (this.loading) return;
    this.loading = true;
    while (this.next) {
      const [wanted, generation, image] = [this.next, this.generation, new Image()];
      this.next = null;
      Object.assign(image, { id: this.image.id, alt: "", draggable: false, src: this.url(wanted) });
      const loaded = await image.decode().then(() => true, () => false);
      // Skip pictures of the previous pipeline, and pictures newer than the one on which a box is drawn.
      if (!loaded || generation !== this.generation || (this.still && this.still.frame < wanted.frame)) continue;
      this.image.replaceWith(image);
      [this.picture, this.image] = [wanted, image];
      this.draw();
    }
    this.loading = false;
  }

  url({ time }) {
    return `pictures/${time}.jpg?${Date.now()}`;
  }

  /** Freeze the picture, and begin to draw a box. */
  async begin() {
    if (this.drawing || !this.picture) return;
    this.drawing = true;
    this.notify();
    const still = await this.actions.freeze();
    if (!still) this.cancel();
    else if (this.drawing) this.still = still;
    else still.leave?.();
  }

  /** Send the box to the pipeline. */
  async accept() {
    if (!this.drawing || !this.box || !this.still || this.asking) return;
    this.asking = true;
    const { x, y, w, h } = this.box;
    const done = await this.actions.follow([x, y, w, h], this.still);
    this.asking = false;
    if (!done) return;
    const { start } = this; // of the next box, which may have begun before the answer
    this.end();
    this.start = start;
  }

  /** Cancel the drawing, and resume the pipeline if this page paused it. */
  cancel(resume = true) {
    if (!this.drawing) return;
    if (resume) this.still?.leave?.();
    this.end();
  }

  end() {
    this.drawing = false;
    this.box = this.start = this.still = null;
    this.notify();
  }

  /** Start to draw with the first pointer; further pointers are ignored until it is released. */
  press(event) {
    if (event.button !== 0 || !this.picture || this.pointer !== null) return;
    this.element.setPointerCapture(event.pointerId);
    this.pointer = event.pointerId;
    this.before = { drawing: this.drawing, box: this.box };
    this.start = { ...this.position(event), screen: [event.clientX, event.clientY] };
  }

  drag(event) {
    if (event.pointerId !== this.pointer || !this.start || this.asking || !this.isMoved(event)) return;
    this.begin();
    const { x, y } = this.position(event);
    this.set(Math.min(x, this.start.x), Math.min(y, this.start.y), Math.abs(x - this.start.x), Math.abs(y - this.start.y));
  }

  /** True once a pointer has moved too far for a click. */
  isMoved({ clientX, clientY }) {
    const [across, down] = this.start.screen;
    return (this.start.moved ||= Math.hypot(clientX - across, clientY - down) >= STILL);
  }

  release(event) {
    if (event.pointerId !== this.pointer) return;
    const { start } = this;
    this.pointer = this.start = null;
    if (!start) return;
    if (!this.drawing) this.choose(start);
    else if (!this.box || this.box.w < this.smallest || this.box.h < this.smallest) {
      this.box = this.before.box;
      this.notify();
    }
  }

  /** Revert the drawing of a pointer, because a second finger zooms or the browser has cancelled the pointer. */
  abort(event) {
    if (event.pointerId !== this.pointer) return;
    this.pointer = this.start = null;
    if (!this.before.drawing) return this.cancel();
    this.box = this.before.box;
    this.notify();
  }

  /** Choose the object with the smallest box that contains a position. */
  choose({ x, y }) {
    const inside = ([, [left, top, w, h]]) => x >= left && x <= left + w && y >= top && y <= top + h;
    const hits = this.shown.filter(inside).sort(([, one], [, other]) => one[2] * one[3] - other[2] * other[3]);
    if (hits.length) this.objects.choose(hits[0][0]);
  }

  /** The boxes of the picture by name, without dropped objects, the chosen object last. */
  get shown() {
    const boxes = Object.entries(this.picture?.boxes ?? {}).filter(([name]) => this.objects.get(name));
    return boxes.sort(([name], [other]) => (name === this.objects.chosen) - (other === this.objects.chosen));
  }

  key(event) {
    if (!this.picture) return;
    const { width, height } = this.picture;
    const step = Math.max(1, Math.round(STEP * Math.min(width, height)));
    const arrows = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (event.key === "Enter") {
      if (this.box) this.accept();
      else {
        this.begin();
        this.set(width * 0.4, height * 0.4, width * 0.2, height * 0.2);
      }
    } else if (event.key === "Escape") this.cancel();
    else if (this.box && event.key in arrows) {
      const [x, y] = arrows[event.key];
      if (event.shiftKey) this.set(this.box.x, this.box.y, Math.max(SMALLEST, this.box.w + x), Math.max(SMALLEST, this.box.h + y));
      else this.set(this.box.x + x, this.box.y + y, this.box.w, this.box.h);
    } else return;
    event.preventDefault();
  }

  set(x, y, w, h) {
    const { width, height } = this.picture;
    [w, h] = [Math.min(w, width), Math.min(h, height)];
    this.box = { x: Math.max(0, Math.min(x, width - w)), y: Math.max(0, Math.min(y, height - h)), w, h };
    this.notify();
  }

  /** Position of a pointer in the frame. */
  position(event) {
    const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.boxes.getScreenCTM().inverse());
    const clamp = (value, most) => Math.max(0, Math.min(most, value));
    return { x: clamp(x, this.picture.width), y: clamp(y, this.picture.height) };
  }

  notify() {
    this.actions.changed(this.drawing, this.box);
    this.draw();
  }

  /** The part of the frame that the stage shows. */
  get view() {
    return [0, 0, this.picture.width, this.picture.height];
  }

  /** Draw the box of each object with its name, or shade the picture and draw the user's box. */
  draw() {
    if (!this.picture) return;
    const { width, height } = this.picture;
    this.boxes.setAttribute("viewBox", this.view.join(" "));
    this.boxes.replaceChildren();
    const { x, y, w, h } = this.box ?? { x: 0, y: 0, w: 0, h: 0 };
    if (this.drawing) this.boxes.append(make("path", { class: "shade", d: `M0 0H${width}V${height}H0ZM${x} ${y}v${h}h${w}v${-h}Z` }));
    const { single, chosen } = this.objects;
    for (const [name, box] of this.drawing && single ? [] : this.shown) {
      const { colour } = this.objects.get(name);
      this.outline(box, colour, !single && name === chosen);
      if (!single) this.label(box, name || "no name", colour);
    }
    if (this.box) this.outline([x, y, w, h], "#fff");
  }

  outline([x, y, width, height], colour, thick = false) {
    for (const stroke of ["#000b", colour]) this.boxes.append(make("rect", { class: thick ? "thick" : "", x, y, width, height, stroke }));
  }

  /** Write a name above the top edge of a box, or below it at the top of the picture. */
  label([x, y], name, colour) {
    const size = TEXT / (this.boxes.getScreenCTM()?.a || 1);
    const text = make("text", { "font-size": size, x: 0.4 * size, y: 1.05 * size }, name);
    const group = make("g", {}, text);
    this.boxes.append(group);
    const [width, height] = [text.getComputedTextLength() + 0.8 * size, 1.45 * size];
    const [left, top] = [Math.max(0, Math.min(x, this.picture.width - width)), y >= height ? y - height : y];
    group.setAttribute("transform", `translate(${left} ${top})`);
    group.prepend(make("rect", { class: "name", fill: colour, width, height }));
  }
}
