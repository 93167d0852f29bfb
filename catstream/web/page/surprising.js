// The frames with the largest surprise, each cropped around the box of its object.

import { arrange } from "./dom.js";

const AROUND = 2.6; // width of a picture in box widths
const [WIDTH, HEIGHT] = [304, 205];

export class SurprisingFrames {
  constructor(element, measured) {
    Object.assign(this, { element, measured, items: new Map() });
  }

  clear() {
    this.items = new Map();
    this.element.replaceChildren();
  }

  show({ measured, frames }) {
    this.measured.textContent = measured
      ? `The ${frames.length} largest of ${measured.toLocaleString("en")} measured frames; those of one object are at least a second apart.`
      : "None yet: the first model is needed to measure.";
    const most = Math.max(...frames.map((frame) => frame.surprise));
    const now = new Map();
    for (const frame of frames) {
      const id = `${frame.frame} ${frame.object} ${frame.surprise}`;
      const item = this.items.get(id) ?? this.make(frame);
      item.share.style.width = `${(100 * frame.surprise) / most}%`;
      now.set(id, item);
    }
    this.items = now;
    arrange(this.element, [...now.values()].map((item) => item.element));
  }

  make(frame) {
    const element = document.createElement("li");
    const canvas = Object.assign(document.createElement("canvas"), { width: WIDTH, height: HEIGHT });
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${frame.object || "the object"} in frame ${frame.frame}`);
    const caption = document.createElement("p");
    const [when, surprise] = [document.createElement("span"), document.createElement("b")];
    when.textContent = `frame ${frame.frame}`;
    surprise.textContent = frame.surprise.toPrecision(3);
    caption.append(when, surprise);
    const share = document.createElement("i");
    element.append(canvas, share, caption);
    if (frame.object) {
      element.style.setProperty("--colour", frame.colour);
      const name = Object.assign(document.createElement("p"), { className: "name" });
      name.append(Object.assign(document.createElement("i"), { className: "swatch" }), frame.object);
      element.append(name);
    }
    const item = { element, canvas, share, frame };
    this.load(item);
    return item;
  }

  async load(item) {
    const response = await fetch(`pictures/${item.frame.frame}.jpg`).catch(() => null);
    item.bitmap = response?.ok ? await createImageBitmap(await response.blob()).catch(() => null) : null;
    this.paint(item);
  }

  draw() {
    for (const item of this.items.values()) this.paint(item);
  }

  paint({ canvas, bitmap, frame }) {
    if (!bitmap) return;
    const scale = bitmap.width / frame.width;
    const [x, y, w, h] = frame.box.map((side) => side * scale);
    const zoom = Math.min(WIDTH / (AROUND * w), HEIGHT / (AROUND * h));
    // Centred on the box, and shifted to stay inside the picture.
    const inside = (centre, side, whole) => (side > whole ? whole / 2 : Math.min(Math.max(centre, side / 2), whole - side / 2));
    const [across, down] = [inside(x + w / 2, WIDTH / zoom, bitmap.width), inside(y + h / 2, HEIGHT / zoom, bitmap.height)];
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, WIDTH, HEIGHT);
    context.setTransform(zoom, 0, 0, zoom, WIDTH / 2 - zoom * across, HEIGHT / 2 - zoom * down);
    context.drawImage(bitmap, 0, 0);
    context.lineWidth = 4 / zoom;
    context.strokeStyle = frame.colour;
    context.strokeRect(x, y, w, h);
    context.setTransform(1, 0, 0, 1, 0, 0);
  }
}
