// The coreset trees. Of a tree its leaves are known: the levels of its nodes are the binary digits of their number,
// since two nodes of a level are always merged. Each node is drawn at the height of its level, above its leaves.

import { add, figure, make, many } from "./dom.js";

const [HEIGHT, EDGE] = [120, 8];

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
    this.show();
  }

  /** Show the trees of the chosen object, by the table of trees: a figure for each, made when it is first received. */
  show(part = this.part) {
    this.part = part;
    const { leaves = [], rows = 0, bytes = 0 } = part.objects[this.name] ?? {};
    this.kept.textContent = rows ? `${rows.toLocaleString("en")} rows in ${(bytes / 1e6).toFixed(1)} MB.` : "";
    for (const [place, { title, meaning }] of part.kinds.entries()) {
      this.draw(this.trees[place] ??= this.add(title, meaning), leaves[place] ?? 0);
    }
  }

  add(title, meaning) {
    const parts = figure(this.element, "tree", title);
    parts.left.className = "label";
    add(parts.caption, "small", { textContent: meaning });
    return parts;
  }

  draw(tree, count) {
    const kept = nodes(count);
    const apart = (tree.drawing.clientWidth - 2 * EDGE) / Math.max(count, 1);
    const rise = Math.min(26, (HEIGHT - 34) / Math.max(kept[0]?.level ?? 0, 1));
    const drawn = kept.flatMap(({ level, from }) => {
      const width = apart * 2 ** level, x = EDGE + apart * from, y = HEIGHT - 16 - rise * level;
      const node = make("circle", { cx: x + width / 2, cy: y, r: Math.max(2.5, Math.min(6, width / 2)) });
      const span = make("polygon", { points: `${x + width / 2},${y} ${x},${HEIGHT - 8} ${x + width},${HEIGHT - 8}` });
      return width > 9 ? [span, node, make("text", { x: x + width / 2, y: y - 9 }, String(level))] : [span, node];
    });
    tree.drawing.replaceChildren(...drawn);
    tree.right.textContent = count ? `${many(count, "leaf", "leaves")} in ${many(kept.length, "node")}` : "no leaf yet";
    tree.drawing.setAttribute("aria-label", count ? `levels ${kept.map(({ level }) => level).join(", ")}` : "empty");
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
