// Helpers for SVG elements.

export function make(name, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

/** A figure with a left and a right caption, and a drawing below. */
export function figure(kind, title, drawing) {
  const element = document.createElement("figure");
  element.className = kind;
  const caption = document.createElement("figcaption");
  const [left, right] = [document.createElement("span"), document.createElement("b")];
  left.textContent = title;
  right.textContent = "–";
  caption.append(left, right);
  element.append(caption, drawing);
  return { element, caption, left, right };
}
