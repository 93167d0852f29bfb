// Four charts of the last two minutes of an object: score, frames per second, latency, model version.

import { figure, make } from "./dom.js";

const [FEWEST, SECONDS] = [15, 120]; // minimum and maximum time span of a chart
const [LEFT, TOP, BOTTOM] = [34, 8, 18];

const CHARTS = [
  { title: "score", column: 2, least: 1, show: (value) => value.toFixed(2) },
  { title: "frames a second", column: 1, least: 10, show: (value) => value.toFixed(0) },
  { title: "learning delay", column: 3, least: 0.5, show: (value) => `${value.toFixed(2)} s` },
  { title: "model version", column: 4, least: 4, show: (value) => value.toFixed(0) },
];

export class Charts {
  constructor(element) {
    this.section = element.closest("section");
    this.rows = [];
    this.name = null;
    this.charts = CHARTS.map((chart) => ({ ...chart, ...figure(element, "chart", chart.title) }));
  }

  clear() {
    this.rows = [];
    this.draw();
  }

  /** Show another object. */
  choose(name) {
    this.name = name;
    this.draw();
  }

  /** Add rows of [second, frames per second, {object: [score, latency, model, present]}]. */
  add(rows) {
    if (!rows.length) return;
    this.rows.push(...rows);
    while (this.rows[0][0] < this.rows.at(-1)[0] - SECONDS) this.rows.shift();
    this.draw();
  }

  draw() {
    this.section.hidden = !this.rows.length;
    const rows = this.rows.filter(([, , objects]) => Object.hasOwn(objects, this.name));
    const points = rows.map(([second, rate, objects]) => [second, rate, ...objects[this.name]]);
    for (const chart of this.charts) this.plot(chart, points);
  }

  /** Plot a column of points [second, frames per second, score, latency, model, present]. */
  plot({ drawing, right, column, least, show, title }, all) {
    const points = all.filter((point) => point[column] !== null);
    const values = points.map((point) => point[column]);
    const now = this.rows.at(-1)?.[0];
    right.textContent = points.at(-1)?.[0] === now && now !== undefined ? show(values.at(-1)) : "–";
    drawing.replaceChildren();
    drawing.setAttribute("aria-label", `${title}: ${right.textContent}`);
    if (!all.length) return;
    const [wide, tall] = [drawing.clientWidth, drawing.clientHeight];
    const seconds = Math.min(SECONDS, Math.max(FEWEST, now - all[0][0]));
    const low = Math.min(0, ...values);
    const high = round(Math.max(least, ...values));
    const x = (second) => LEFT + (wide - LEFT) * (1 - (now - second) / seconds);
    const y = (value) => TOP + (tall - TOP - BOTTOM) * (1 - (value - low) / (high - low));
    const grid = [0, high].flatMap((value) => [
      make("line", { class: "grid", x1: LEFT, x2: wide, y1: y(value), y2: y(value) }),
      make("text", { x: LEFT - 6, y: y(value) + 4, "text-anchor": "end" }, String(value)),
    ]);
    grid.push(make("text", { x: LEFT, y: tall - 3 }, `${Math.round(seconds)} s ago`));
    grid.push(make("text", { x: wide, y: tall - 3, "text-anchor": "end" }, "now"));
    const absences = spans(all).map(([from, to]) =>
      make("rect", { class: "away", x: x(from), y: TOP, width: Math.max(1, x(to) - x(from)), height: tall - TOP - BOTTOM }));
    const lines = pieces(points).map((piece) =>
      make("polyline", { points: piece.map((point) => `${x(point[0]).toFixed(1)},${y(point[column]).toFixed(1)}`).join(" ") }));
    drawing.append(...absences, ...grid, ...lines);
  }
}

/** Round up to a limit for an axis. */
function round(value) {
  const ten = 10 ** Math.floor(Math.log10(value));
  return Number((ten * [1, 1.2, 1.5, 2, 3, 4, 5, 6, 8, 10].find((part) => value <= part * ten * 1.000001)).toPrecision(3));
}

/** Time spans in which the object was absent. */
function spans(points) {
  const absences = [];
  points.forEach((point, index) => {
    if (point[5] || index === 0) return;
    const previous = points[index - 1];
    if (absences.length && absences.at(-1)[1] === previous[0]) absences.at(-1)[1] = point[0];
    else absences.push([previous[0], point[0]]);
  });
  return absences;
}

/** Split points at gaps of more than two seconds. */
function pieces(points) {
  const parts = [];
  points.forEach((point, index) => {
    if (index === 0 || point[0] - points[index - 1][0] > 2) parts.push([]);
    parts.at(-1).push(point);
  });
  return parts;
}
