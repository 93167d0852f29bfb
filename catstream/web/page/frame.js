// A frame of a video with zoom and pan; the box of the chosen object can be drawn, and its edges can be dragged.

import { make } from "./dom.js";
import { Stage } from "./stage.js";

const LARGE = 1920; // longest side of a picture that is not scaled down
const MOST = 40; // maximum zoom, in pixels of the screen for a pixel of the video
const SQUARES = 4; // minimum zoom at which pixels are drawn as squares
const NEAR = { mouse: 6, touch: 16 }; // maximum distance of a pointer from the edge that it drags, in pixels of the screen
const ROOMY = 24; // minimum side of a box with edges that can be dragged, in pixels of the screen
const CORNER = 8; // side of the mark of a corner, in pixels of the screen

/** A box is saved as soon as it is drawn. The objects have a `focus`: the box to show, or undefined. */
export class FrameStage extends Stage {
  constructor(element, objects, actions) {
    super(element, objects, actions);
    Object.assign(this, { smallest: 3, zoom: 1, middle: [0, 0], edges: null, hands: new Map(), moving: false, grabs: false });
    element.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    element.addEventListener("mousedown", (event) => event.button === 1 && event.preventDefault()); // no scrolling by the browser
    const lift = ({ pointerId }) => { this.hands.delete(pointerId); this.moving &&= this.hands.size > 0; };
    for (const kind of ["pointerup", "pointercancel"]) addEventListener(kind, lift);
  }

  url({ frame, query, full }) {
    return `frames/${frame}.jpg?${query}${full ? "&full" : ""}`.replace(/\?$/, "");
  }

  /** Load and show a picture, in full resolution if it is zoomed. */
  show(picture) {
    picture.full = this.needsAll(picture);
    return super.show(picture);
  }

  needsAll({ width, height }) {
    return this.zoom > 1 && Math.max(width, height) > LARGE;
  }

  /** Size of a pixel of the video on the screen. */
  get scale() {
    const { element: { clientWidth, clientHeight }, picture: { width, height } } = this;
    return this.zoom * Math.min(clientWidth / width, clientHeight / height);
  }

  /** The visible part of the frame, around its centre `middle`. */
  get view() {
    const { element: { clientWidth, clientHeight }, middle: [x, y], scale } = this;
    return [x - clientWidth / scale / 2, y - clientHeight / scale / 2, clientWidth / scale, clientHeight / scale];
  }

  /** Zoom by a factor, 0 for the whole picture, around a position in the frame, by default the visible box or the centre. */
  zoomBy(factor, position = null) {
    if (!this.picture) return;
    if (!position && this.shows(centre(this.objects.focus))) this.middle = centre(this.objects.focus);
    const { zoom, scale, middle } = this, [x, y] = position ?? middle;
    this.zoom = Math.max(1, Math.min(zoom * factor, MOST * zoom / scale));
    this.middle = [x + (middle[0] - x) * zoom / this.zoom, y + (middle[1] - y) * zoom / this.zoom];
    if (this.needsAll(this.picture) && !this.picture.full) this.show(this.picture);
    this.draw();
  }

  /** Move the picture by pixels of the screen. */
  moveBy(x, y) {
    this.middle = [this.middle[0] - x / this.scale, this.middle[1] - y / this.scale];
    this.draw();
  }

  /** Move the picture so that the focus is visible. */
  reveal() {
    const position = centre(this.objects.focus);
    if (position && !this.shows(position)) this.middle = position;
    this.draw();
  }

  shows(position) {
    if (!position) return false;
    const [left, top, width, height] = this.view, [x, y] = position;
    return x >= left && x <= left + width && y >= top && y <= top + height;
  }

  wheel(event) {
    const { deltaX, deltaY, deltaMode, ctrlKey } = event, unit = [1, 16, 400][deltaMode];
    if (!this.picture || (this.zoom === 1 && (deltaY >= 0 || event.shiftKey))) return; // the page scrolls
    event.preventDefault();
    if (event.shiftKey || Math.abs(deltaX) > Math.abs(deltaY)) this.moveBy(-unit * (deltaX || deltaY), 0);
    else this.zoomBy(2 ** Math.max(-1, Math.min(1, -deltaY * unit / (ctrlKey ? 60 : 400))), this.point(event)); // a pinch gesture has small steps
  }

  /** The first pointer draws; two fingers, the middle button or the space bar move the picture. */
  press(event) {
    const moves = event.button === 1 || this.grabs;
    if (!this.picture || (this.pointer !== null && !this.hands.has(this.pointer))) return; // a palm next to a pen
    if (event.pointerType === "touch" || moves) this.hands.set(event.pointerId, event);
    this.moving ||= moves || this.hands.size > 1;
    if (!this.moving) {
      this.edges = this.edgesAt(event);
      return super.press(event);
    }
    this.abort({ pointerId: this.pointer });
    this.element.setPointerCapture(event.pointerId);
  }

  drag(event) {
    if (this.moving && this.hands.has(event.pointerId)) this.grab(event);
    else if (event.pointerId !== this.pointer || !this.edges) {
      this.showCursor(this.edgesAt(event));
      super.drag(event);
    } else if (this.isMoved(event)) {
      // Step 1: Move the dragged edges by the movement of the pointer.
      const { across, down, box: { x, y, w, h } } = this.edges, position = this.position(event);
      const [right, below] = [position.x - this.start.x, position.y - this.start.y];
      const columns = [x + (across < 0) * right, x + w + (across > 0) * right].sort((one, other) => one - other);
      const rows = [y + (down < 0) * below, y + h + (down > 0) * below].sort((one, other) => one - other);
      // Step 2: Set the box between the edges, which may have passed each other.
      this.begin();
      this.set(columns[0], rows[0], columns[1] - columns[0], rows[1] - rows[0]);
    }
  }

  /** Move and zoom the picture with its pointers. */
  grab(event) {
    const [[x, y], size] = span(this.hands), at = this.point({ clientX: x, clientY: y });
    this.hands.set(event.pointerId, event);
    const [[right, down], larger] = span(this.hands);
    this.zoomBy(larger / size, at);
    this.moveBy(right - x, down - y);
  }

  release(event) {
    if (event.pointerId !== this.pointer) return;
    super.release(event);
    if (this.box !== this.before.box) this.save();
    else if (!this.before.drawing) this.cancel();
  }

  /** The edges of the box under a pointer: -1 for left or top, 1 for right or bottom; null without an edge or in a small box. */
  edgesAt(event) {
    const box = this.changeable;
    if (!box) return null;
    const { x, y } = this.position(event), near = NEAR[event.pointerType] ?? NEAR.mouse;
    const edge = (value, from, size) => {
      const reach = Math.min(near / this.scale, size / 4);
      return Math.abs(value - from) <= reach ? -1 : Math.abs(value - from - size) <= reach ? 1 : value < from || value > from + size ? null : 0;
    };
    const [across, down] = [edge(x, box.x, box.w), edge(y, box.y, box.h)];
    return across !== null && down !== null && (across || down) ? { across, down, box } : null;
  }

  /** The box with edges that can be dragged: the box being drawn, or the chosen object's. */
  get changeable() {
    const [x, y, w, h] = this.picture?.boxes[this.objects.chosen] ?? [];
    const box = this.box ?? (x === undefined || this.drawing ? null : { x, y, w, h });
    return box && Math.min(box.w, box.h) * this.scale >= ROOMY ? box : null;
  }

  showCursor(edges) {
    const { across, down } = edges ?? { across: 0, down: 0 };
    this.element.style.cursor = this.moving || this.grabs ? "grab" : !edges ? "" : !down ? "ew-resize" : !across ? "ns-resize" : across === down ? "nwse-resize" : "nesw-resize";
  }

  /** Change the box with a key; returns false for other keys. */
  key(event) {
    const { box } = this, by = event.shiftKey ? 10 : 1;
    const arrows = { ArrowLeft: [-by, 0], ArrowRight: [by, 0], ArrowUp: [0, -by], ArrowDown: [0, by] };
    const [x, y] = arrows[event.key] ?? [0, 0];
    if (event.key === "Escape") this.cancel();
    else if (event.key === "Enter") this.save();
    else if (!box || !(event.key in arrows)) return false;
    else if (event.ctrlKey || event.metaKey) this.change(box.x, box.y, Math.max(1, box.w + x), Math.max(1, box.h + y));
    else this.change(box.x + x, box.y + y, box.w, box.h);
    return true;
  }

  change(...box) {
    this.changed = true;
    this.set(...box);
  }

  /** Save the box if it was changed by keys, and end the drawing. */
  leave() {
    return this.changed ? this.save() : this.cancel();
  }

  /** Save the box, if there is one, and end the drawing. */
  save() {
    const { box } = this;
    this.cancel();
    return box && this.actions.follow([box.x, box.y, box.w, box.h]);
  }

  end() {
    this.changed = false;
    super.end();
  }

  /** Position of a pointer in the frame, rounded to a border between pixels. */
  position(event) {
    const { x, y } = super.position(event);
    return { x: Math.round(x), y: Math.round(y) };
  }

  point(event) {
    const { x, y } = super.position(event);
    return [x, y];
  }

  draw() {
    if (!this.picture || !this.element.clientWidth) return;
    // Step 1: Limit the centre so that a zoomed picture covers the stage.
    const { width, height } = this.picture, { zoom, scale, image: { style } } = this;
    const within = (value, size, shown) => (shown < size ? Math.max(shown / 2, Math.min(size - shown / 2, value)) : size / 2);
    this.middle = [within(this.middle[0], width, this.view[2]), within(this.middle[1], height, this.view[3])];
    style.transform = zoom > 1 ? `translate(${scale * (width / 2 - this.middle[0])}px, ${scale * (height / 2 - this.middle[1])}px) scale(${zoom})` : "";
    style.imageRendering = zoom > 1 && scale * devicePixelRatio >= SQUARES ? "pixelated" : "";
    // Step 2: Draw the boxes, and the corners of the box with edges that can be dragged.
    super.draw();
    const box = this.changeable, side = CORNER / scale;
    for (const x of box ? [box.x, box.x + box.w] : []) {
      for (const y of [box.y, box.y + box.h]) this.boxes.append(make("rect", { class: "corner", x: x - side / 2, y: y - side / 2, width: side, height: side }));
    }
    this.actions.zoomed(scale);
  }
}

const centre = (box) => box && [box[0] + box[2] / 2, box[1] + box[3] / 2];

/** The midpoint of two pointers, or the position of the only one, and their distance. */
function span(hands) {
  const [one, other = one] = hands.values();
  const distance = Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
  return [[(one.clientX + other.clientX) / 2, (one.clientY + other.clientY) / 2], distance || 1];
}
