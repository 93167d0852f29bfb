// The film: the frames that taught most, each cut out around its box.

const AROUND = 2.6; // times the box that a picture shows
const [WIDTH, HEIGHT] = [304, 205];

export class Film {
  constructor(element, measured) {
    Object.assign(this, { element, measured, shots: new Map() });
  }

  clear() {
    this.shots = new Map();
    this.element.replaceChildren();
  }

  show({ frames, shots }) {
    this.measured.textContent = frames
      ? `The ${shots.length} most of ${frames.toLocaleString("en")} frames that came as pictures with a model to measure by, a second apart.`
      : "Nothing yet: it takes a first model to be wrong.";
    const most = Math.max(...shots.map((shot) => shot.taught));
    const now = new Map();
    for (const shot of shots) {
      const id = `${shot.frame} ${shot.taught}`;
      const item = this.shots.get(id) ?? this.make(shot);
      item.share.style.width = `${(100 * shot.taught) / most}%`;
      now.set(id, item);
    }
    this.shots = now;
    const items = [...now.values()].map((item) => item.element);
    const shown = [...this.element.children];
    if (items.length !== shown.length || items.some((item, index) => item !== shown[index])) this.element.replaceChildren(...items);
  }

  make(shot) {
    const element = document.createElement("li");
    const canvas = Object.assign(document.createElement("canvas"), { width: WIDTH, height: HEIGHT });
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `the object in frame ${shot.frame}`);
    const caption = document.createElement("p");
    const [when, taught] = [document.createElement("span"), document.createElement("b")];
    when.textContent = `frame ${shot.frame}`;
    taught.textContent = shot.taught.toPrecision(3);
    caption.append(when, taught);
    const share = document.createElement("i");
    element.append(canvas, share, caption);
    const item = { element, canvas, share, shot };
    this.load(item);
    return item;
  }

  async load(item) {
    const response = await fetch(`/pictures/${item.shot.frame}.jpg`).catch(() => null);
    item.bitmap = response?.ok ? await createImageBitmap(await response.blob()).catch(() => null) : null;
    this.paint(item);
  }

  draw() {
    for (const item of this.shots.values()) this.paint(item);
  }

  paint({ canvas, bitmap, shot }) {
    if (!bitmap) return;
    const scale = bitmap.width / shot.width;
    const [x, y, w, h] = shot.box.map((side) => side * scale);
    const zoom = Math.min(WIDTH / (AROUND * w), HEIGHT / (AROUND * h));
    // Around the box, as far as the picture goes.
    const inside = (centre, side, whole) => (side > whole ? whole / 2 : Math.min(Math.max(centre, side / 2), whole - side / 2));
    const [across, down] = [inside(x + w / 2, WIDTH / zoom, bitmap.width), inside(y + h / 2, HEIGHT / zoom, bitmap.height)];
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, WIDTH, HEIGHT);
    context.setTransform(zoom, 0, 0, zoom, WIDTH / 2 - zoom * across, HEIGHT / 2 - zoom * down);
    context.drawImage(bitmap, 0, 0);
    context.lineWidth = 4 / zoom;
    context.strokeStyle = "#ff922b";
    context.strokeRect(x, y, w, h);
    context.setTransform(1, 0, 0, 1, 0, 0);
  }
}
