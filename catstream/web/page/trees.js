// The coreset trees. Of a tree its leaves are known: the levels of its nodes are the binary digits of their number,
// since two nodes of a level are always merged. So each node, kept or merged, has its place above its leaves.

import { add, figure, make, many } from "./dom.js";

const [HEIGHT, EDGE] = [120, 8];
const CLOSEST = 7; // pixels between two nodes of a level that is still drawn

export class Trees {
  constructor(element, kept) {
    this.element = element;
    this.kept = kept;
    this.trees = [];
    this.part = { kinds: [], objects: {} };
    this.name = null;
  }

  /** Show another object. */
  choose(name) {
    this.name = name;
    for (const tree of this.trees) tree.leaves = -1;
    this.show(this.part);
  }

  /** Show the trees of the chosen object, by the table of trees: a figure for each, made when it is first received. */
  show(part) {
    this.part = part;
    const { leaves = [], rows = 0, bytes = 0 } = part.objects[this.name] ?? {};
    this.kept.textContent = rows ? `${rows.toLocaleString("en")} rows in ${(bytes / 1e6).toFixed(1)} MB.` : "";
    for (const [place, { title, meaning }] of part.kinds.entries()) {
      const tree = this.trees[place] ??= this.add(title, meaning);
      const count = leaves[place] ?? 0;
      if (count !== tree.leaves) this.draw(tree, count);
    }
  }

  add(title, meaning) {
    const parts = figure(this.element, "tree", title);
    parts.left.className = "label";
    add(parts.caption, "small", { textContent: meaning });
    return { ...parts, leaves: -1 };
  }

  redraw() {
    for (const tree of this.trees) if (tree.leaves >= 0) this.draw(tree, tree.leaves);
  }

  draw(tree, count) {
    const before = new Set(nodes(Math.max(0, tree.leaves)).map(key));
    const kept = nodes(count);
    const top = kept.length ? kept[0].level : 0;
    const apart = (tree.drawing.clientWidth - 2 * EDGE) / Math.max(count, 1);
    const rise = Math.min(26, (HEIGHT - 34) / Math.max(top, 1));
    const x = ({ level, from }) => EDGE + apart * (from + 2 ** level / 2);
    const y = ({ level }) => HEIGHT - 16 - rise * level;
    const [lines, fans, merged, filled] = [[], [], [], []];
    const ends = ({ level, from }) => [EDGE + apart * from, EDGE + apart * (from + 2 ** level)];
    const below = (node) => {
      if (!node.level) return;
      if (apart * 2 ** (node.level - 1) < CLOSEST) { // too close to be distinguished
        fans.push(`M${x(node)} ${y(node)}L${ends(node).map((end) => `${end} ${HEIGHT - 14}`).join("L")}Z`);
        return;
      }
      const half = 2 ** (node.level - 1);
      for (const child of [{ level: node.level - 1, from: node.from }, { level: node.level - 1, from: node.from + half }]) {
        lines.push(`M${x(node)} ${y(node)}L${x(child)} ${y(child)}`);
        merged.push(make("circle", { cx: x(child), cy: y(child), r: 2.2 }));
        below(child);
      }
    };
    for (const node of kept) {
      below(node);
      const [from, to] = ends(node);
      const r = Math.max(2.5, Math.min(6, (to - from) / 2));
      filled.push(make("rect", { class: "span", x: from + 0.5, y: HEIGHT - 10, width: Math.max(1, to - from - 1), height: 4 }));
      filled.push(make("circle", { class: before.has(key(node)) ? "node" : "node new", cx: x(node), cy: y(node), r }));
      if (to - from > 9) filled.push(make("text", { x: x(node), y: y(node) - 9 }, String(node.level)));
    }
    tree.drawing.replaceChildren(make("path", { class: "fan", d: fans.join("") }), make("path", { d: lines.join("") }), ...merged, ...filled);
    tree.right.textContent = count ? `${many(count, "leaf", "leaves")} in ${many(kept.length, "node")}` : "no leaf yet";
    tree.drawing.setAttribute("aria-label", count ? `levels ${kept.map(({ level }) => level).join(", ")}` : "empty");
    tree.leaves = count;
  }
}

/** Nodes in memory, oldest first: level, and the first leaf that each stands for. */
function nodes(count) {
  const found = [];
  for (let level = Math.floor(Math.log2(Math.max(count, 1))), from = 0; level >= 0; level--) {
    if (Math.floor(count / 2 ** level) % 2 === 0) continue;
    found.push({ level, from });
    from += 2 ** level;
  }
  return found;
}

const key = ({ level, from }) => `${level}:${from}`;
