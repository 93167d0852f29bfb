// The live picture with the boxes of its objects, and the box that the user draws with mouse, touch or keyboard.

const STEP = 0.02; // distance of an arrow key, as a share of the picture's shorter side
const SMALLEST = 6; // minimum side of a box in pixels of the frame
const STILL = 4; // pixels of the screen that a pointer may move in a click

export class Stage {
  /**
   * objects: the list of the objects. actions: pause() pauses the pipeline and returns {frame, leave}; follow(box, leave)
   * sends the box; changed(drawing, box) is called whenever the drawing changes.
   */
  constructor(element, canvas, objects, actions) {
    Object.assign(this, { element, canvas, objects, actions });
    this.picture = this.bitmap = this.box = this.start = this.still = null;
    this.drawing = this.loading = false;
    this.turn = 0; // number of pipelines shown before
    element.addEventListener("pointerdown", (event) => this.press(event));
    element.addEventListener("pointermove", (event) => this.drag(event));
    element.addEventListener("pointerup", () => this.release());
    element.addEventListener("pointercancel", () => this.release(false));
    element.addEventListener("keydown", (event) => this.key(event));
  }

  get hasPicture() {
    return this.bitmap !== null;
  }

  /** Clear the picture, because another pipeline is shown. */
  clear() {
    this.cancel(false);
    this.bitmap?.close();
    this.picture = this.bitmap = this.next = null;
    this.turn += 1;
    this.canvas.getContext("2d").clearRect(0, 0, this.canvas.width, this.canvas.height);
  }

  /** Load and show a picture; while another one is loading, only the newest is loaded next. */
  async show(picture) {
    this.next = picture;
    if (this.loading) return;
    this.loading = true;
    while (this.next) {
      const [wanted, turn] = [this.next, this.turn];
      this.next = null;
      const response = await fetch(`pictures/${wanted.frame}.jpg`).catch(() => null);
      if (!response?.ok || (this.still && this.still.frame < wanted.frame)) continue; // the picture is frozen for drawing
      const bitmap = await createImageBitmap(await response.blob()).catch(() => null);
      if (!bitmap) continue;
      if (turn !== this.turn) { // a picture of the previous pipeline
        bitmap.close();
        continue;
      }
      this.bitmap?.close();
      [this.picture, this.bitmap] = [wanted, bitmap];
      this.draw();
    }
    this.loading = false;
  }

  /** Pause, and begin to draw a box. */
  async begin() {
    if (this.drawing || !this.picture) return;
    this.drawing = true;
    this.tell();
    const still = await this.actions.pause();
    if (!still) this.cancel();
    else if (this.drawing) this.still = still;
    else still.leave?.();
  }

  /** Send the box to the pipeline. */
  async accept() {
    if (!this.drawing || !this.box || !this.still || this.asking) return;
    this.asking = true;
    const { x, y, w, h } = this.box;
    const done = await this.actions.follow([x, y, w, h], this.still.leave);
    this.asking = false;
    if (!done) return;
    const { start } = this; // of the next box: the picture may run again before the answer is here
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
    this.tell();
  }

  press(event) {
    if (event.button !== 0 || !this.picture) return;
    this.element.setPointerCapture(event.pointerId);
    this.start = { ...this.place(event), screen: [event.clientX, event.clientY] };
  }

  drag(event) {
    if (!this.start || this.asking) return;
    const [across, down] = this.start.screen;
    if (!this.box && Math.hypot(event.clientX - across, event.clientY - down) < STILL) return;
    this.begin();
    const { x, y } = this.place(event);
    this.set(Math.min(x, this.start.x), Math.min(y, this.start.y), Math.abs(x - this.start.x), Math.abs(y - this.start.y));
  }

  release(clicked = true) {
    if (!this.start) return;
    const place = this.start;
    this.start = null;
    if (!this.drawing) {
      if (clicked) this.choose(place);
    } else if (!this.box || this.box.w < SMALLEST || this.box.h < SMALLEST) {
      this.box = null;
      this.tell();
    }
  }

  /** Choose the object whose box contains a place; the smallest one, if there are several. */
  choose({ x, y }) {
    const inside = ([, [left, top, w, h]]) => x >= left && x <= left + w && y >= top && y <= top + h;
    const found = this.boxes.filter(inside).sort(([, one], [, other]) => one[2] * one[3] - other[2] * other[3]);
    if (found.length) this.objects.choose(found[0][0]);
  }

  /** The boxes of the picture, by name; those of objects that were dropped are left out, and the chosen one is last. */
  get boxes() {
    const boxes = Object.entries(this.picture?.boxes ?? {}).filter(([name]) => this.objects.get(name));
    return boxes.sort(([name], [other]) => (name === this.objects.chosen) - (other === this.objects.chosen));
  }

  key(event) {
    const { width, height } = this.picture ?? { width: 0, height: 0 };
    const step = Math.max(1, Math.round(STEP * Math.min(width, height)));
    const arrows = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (event.key === "Enter" && this.picture) {
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
    this.tell();
  }

  /** Position of a pointer in the frame. */
  place(event) {
    const view = this.canvas.getBoundingClientRect();
    const { width, height } = this.picture;
    const scale = Math.min(view.width / width, view.height / height); // object-fit: contain
    const left = view.left + (view.width - width * scale) / 2;
    const top = view.top + (view.height - height * scale) / 2;
    const inside = (value, most) => Math.max(0, Math.min(most, value));
    return { x: inside((event.clientX - left) / scale, width), y: inside((event.clientY - top) / scale, height) };
  }

  tell() {
    this.actions.changed(this.drawing, this.box);
    this.draw();
  }

  draw() {
    if (!this.bitmap) return;
    const { canvas, bitmap, picture } = this;
    const wide = Math.max(bitmap.width, Math.round(Math.min(canvas.clientWidth, 1280) * Math.min(devicePixelRatio, 2)));
    const tall = Math.round((wide * picture.height) / picture.width);
    if (canvas.width !== wide || canvas.height !== tall) [canvas.width, canvas.height] = [wide, tall];
    const context = canvas.getContext("2d");
    const scale = wide / picture.width;
    context.drawImage(bitmap, 0, 0, wide, tall);
    context.fillStyle = "#0007";
    if (this.drawing) context.fillRect(0, 0, wide, tall);
    if (!this.drawing || !this.objects.single) this.outlines(context, scale, wide);
    if (!this.drawing || !this.box) return;
    const { x, y, w, h } = this.box;
    const own = bitmap.width / picture.width;
    context.drawImage(bitmap, x * own, y * own, w * own, h * own, x * scale, y * scale, w * scale, h * scale);
    outline(context, [x, y, w, h].map((side) => side * scale), "#ffffff", wide / 260);
  }

  /** Draw the box of each object with its name; the chosen one is thicker. */
  outlines(context, scale, wide) {
    const { single, chosen } = this.objects;
    for (const [name, box] of this.boxes) {
      const { colour } = this.objects.get(name);
      const scaled = box.map((side) => side * scale);
      outline(context, scaled, colour, wide / (single || name !== chosen ? 260 : 170));
      const size = Math.max((13 * wide) / this.canvas.clientWidth, wide / 48);
      if (!single) label(context, scaled, name || "no name", colour, size, wide);
    }
  }
}

function outline(context, box, colour, width) {
  const thin = Math.max(2, width);
  context.lineWidth = thin * 2.2;
  context.strokeStyle = "#000b";
  context.strokeRect(...box);
  context.lineWidth = thin;
  context.strokeStyle = colour;
  context.strokeRect(...box);
}

/** Write a name above a box, or below its upper side if there is no room. */
function label(context, [x, y], name, colour, size, wide) {
  context.font = `600 ${size}px system-ui, "DejaVu Sans", sans-serif`;
  const [across, down] = [Math.min(context.measureText(name).width + 0.8 * size, wide), 1.45 * size];
  const left = Math.max(0, Math.min(x - 1, wide - across));
  const top = y >= down ? y - down : y;
  context.fillStyle = colour;
  context.fillRect(left, top, across, down);
  context.fillStyle = "#111";
  context.textBaseline = "middle";
  context.fillText(name, left + 0.4 * size, top + 0.53 * down, across);
}
