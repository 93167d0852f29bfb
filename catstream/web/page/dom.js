// Helpers for HTML elements.

/** Append a new element, with some of its properties. */
export function add(parent, tag, properties = {}) {
  const child = Object.assign(document.createElement(tag), properties);
  parent.append(child);
  return child;
}

/** Change the text of an element, if it is another one. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Give an element these children in this order, if it has others. */
export function arrange(element, children) {
  const shown = element.children;
  if (children.length !== shown.length || children.some((child, place) => child !== shown[place])) element.replaceChildren(...children);
}
