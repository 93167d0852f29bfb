// The frames with the largest surprise, each cropped around the box of its object.

import { add, Items, make } from "./dom.js";

const AROUND = 2.6; // width of a picture in box widths
const SHAPE = 3 / 2; // width / height of a picture

export class SurprisingFrames {
  constructor(element, measured) {
    this.measured = measured;
    this.items = new Items(element, { make: (_, { frame }) => picture(frame), fill: ({ share }, { part }) => { share.style.width = `${100 * part}%`; } });
  }

  show({ measured, frames }) {
    this.measured.textContent = measured
      ? `The ${frames.length} largest of ${measured.toLocaleString("en")} measured frames; those of one object are at least a second apart.`
      : "None yet: the first model is needed to measure.";
    const most = Math.max(...frames.map((frame) => frame.surprise));
    this.items.show(frames.map((frame) => [`${frame.frame} ${frame.object} ${frame.surprise}`, { frame, part: frame.surprise / most }]));
  }
}

function picture(frame) {
  const element = document.createElement("li");
  element.style.setProperty("--colour", frame.colour);
  element.append(cropped(frame));
  const share = add(element, "i");
  const caption = add(element, "p");
  add(caption, "span", { textContent: `frame ${frame.frame}` });
  add(caption, "b", { textContent: frame.surprise.toPrecision(3) });
  if (frame.object) {
    const name = add(element, "p", { className: "name" });
    add(name, "i", { className: "swatch" });
    name.append(frame.object);
  }
  return { element, share };
}

/** The part of a picture around the box, centred on it and shifted to stay inside the picture. */
function cropped({ frame, object, colour, box: [x, y, w, h], width, height }) {
  const own = Math.max(w, SHAPE * h); // width of the smallest view that has the whole box
  const wide = Math.max(own, Math.min(AROUND * own, width, SHAPE * height));
  const inside = (centre, side, whole) => (side > whole ? (whole - side) / 2 : Math.min(Math.max(centre - side / 2, 0), whole - side));
  const view = [inside(x + w / 2, wide, width), inside(y + h / 2, wide / SHAPE, height), wide, wide / SHAPE];
  return make("svg", { role: "img", "aria-label": `${object || "the object"} in frame ${frame}`, viewBox: view.join(" ") },
    make("image", { href: `pictures/${frame}.jpg`, width, height, preserveAspectRatio: "none" }),
    make("rect", { x, y, width: w, height: h, stroke: colour }));
}
