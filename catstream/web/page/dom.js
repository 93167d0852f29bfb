// Helpers for the elements of the page.

/** The first element that matches a CSS selector. */
export const $ = (selector) => document.querySelector(selector);

/** Append a new element with properties. */
export function add(parent, tag, properties = {}) {
  const child = Object.assign(document.createElement(tag), properties);
  parent.append(child);
  return child;
}

/** A new SVG element with its attributes and children. */
export function make(name, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

/** Set the text of an element, if it is different. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A number with its noun. */
export const many = (count, noun, nouns = `${noun}s`) => `${count.toLocaleString("en")} ${count === 1 ? noun : nouns}`;

/** Format a time span in the largest unit with a value of at least two. */
export function duration(seconds) {
  if (seconds < 120) return `${seconds} s`;
  return seconds < 7200 ? `${Math.floor(seconds / 60)} min` : `${Math.floor(seconds / 3600)} h`;
}

/** Send fields to the server as JSON; returns its answer, or the reason of a failure. */
export async function post(url, fields) {
  try {
    const headers = { "Content-Type": "application/json" };
    const response = await fetch(url, { method: "POST", headers, keepalive: true, body: JSON.stringify(fields) }); // keepalive: even if the page is closed
    const json = (response.headers.get("Content-Type") || "").startsWith("application/json");
    return json ? await response.json() : { done: false, reason: (await response.text()).trim() };
  } catch {
    return { done: false, reason: "the server of this page does not answer" };
  }
}

/** Append a figure with a left and a right caption, and an SVG drawing below. */
export function figure(parent, className, title) {
  const element = add(parent, "figure", { className });
  const caption = add(element, "figcaption");
  const left = add(caption, "span", { textContent: title });
  const right = add(caption, "b", { textContent: "–" });
  const drawing = make("svg", { role: "img" });
  element.append(drawing);
  return { caption, left, right, drawing };
}

/** The children of an element by name: each is created when its name is first shown, and removed when it is not. */
export class Items {
  /** make(name, value) returns an item with its `element`; fill(item, value) shows a value in it. */
  constructor(parent, { make, fill }) {
    Object.assign(this, { parent, make, fill, items: new Map() });
  }

  /** Show pairs of name and value in this order; only changed values and positions are updated. */
  show(pairs) {
    const items = new Map(pairs.map(([name, value]) => [name, this.items.get(name) ?? this.make(name, value)]));
    for (const [name, item] of this.items) if (!items.has(name)) item.element.remove();
    this.items = items;
    let next = this.parent.firstElementChild;
    for (const [name, value] of pairs) {
      const item = items.get(name), text = JSON.stringify(value);
      if (item.text !== text) this.fill(item, value);
      item.text = text;
      if (item.element === next) next = next.nextElementSibling;
      else this.parent.insertBefore(item.element, next);
    }
  }
}
