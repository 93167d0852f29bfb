// The coreset trees. The number of leaves determines a tree: the levels of its nodes are the ones in its binary digits,
// since two nodes of equal level are always merged. Each node is drawn at the height of its level, above its leaves.

import { add, figure, make, many } from "./dom.js";

const [HEIGHT, EDGE] = [120, 8];

export class Trees {
  constructor(element, summary) {
    this.element = element;
    this.summary = summary;
    this.trees = [];
    this.part = { kinds: [], objects: {} };
    this.name = null;
  }

  /** Show another object. */
  choose(name) {
    this.name = name;
    this.show();
  }

  /** Show the trees of the chosen object; the figure of a tree is created when the tree is first received. */
  show(part = this.part) {
    this.part = part;
    const { leaves = [], rows = 0, bytes = 0 } = part.objects[this.name] ?? {};
    this.summary.textContent = rows ? `${rows.toLocaleString("en")} rows in ${(bytes / 1e6).toFixed(1)} MB.` : "";
    for (const [index, { title, meaning }] of part.kinds.entries()) {
      this.draw(this.trees[index] ??= this.add(title, meaning), leaves[index] ?? 0);
    }
  }

  add(title, meaning) {
    const parts = figure(this.element, "tree", title);
    parts.left.className = "label";
    add(parts.caption, "small", { textContent: meaning });
    return parts;
  }

  draw(tree, count) {
    const all = nodes(count);
    const spacing = (tree.drawing.clientWidth - 2 * EDGE) / Math.max(count, 1);
    const rise = Math.min(26, (HEIGHT - 34) / Math.max(all[0]?.level ?? 0, 1));
    const drawn = all.flatMap(({ level, from }) => {
      const width = spacing * 2 ** level, x = EDGE + spacing * from, y = HEIGHT - 16 - rise * level;
      const node = make("circle", { cx: x + width / 2, cy: y, r: Math.max(2.5, Math.min(6, width / 2)) });
      const span = make("polygon", { points: `${x + width / 2},${y} ${x},${HEIGHT - 8} ${x + width},${HEIGHT - 8}` });
      return width > 9 ? [span, node, make("text", { x: x + width / 2, y: y - 9 }, String(level))] : [span, node];
    });
    tree.drawing.replaceChildren(...drawn);
    tree.right.textContent = count ? `${many(count, "leaf", "leaves")} in ${many(all.length, "node")}` : "no leaf yet";
    tree.drawing.setAttribute("aria-label", count ? `levels ${all.map(({ level }) => level).join(", ")}` : "empty");
  }
}

/** Nodes in memory, oldest first, each with its level and the number of its first leaf. */
function nodes(count) {
  const all = [];
  for (let level = Math.floor(Math.log2(Math.max(count, 1))), from = 0; level >= 0; level--) {
    if (Math.floor(count / 2 ** level) % 2 === 0) continue;
    all.push({ level, from });
    from += 2 ** level;
  }
  return all;
}
