// A line chart in SVG: axes, points, legend, and a readout that follows the pointer or the arrow keys.

import { count, h, svg } from "./dom.js";

const MARGIN = { top: 12, right: 22, bottom: 40, left: 52 };
const HEIGHT = 250;
const MARKERS = [ // one shape a series, so that colour is never the only difference
  "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0-8 0z",
  "M-3.7-3.7h7.4v7.4h-7.4z",
  "M0-5L5 0L0 5L-5 0z",
  "M0-5L4.8 3.8H-4.8z",
  "M0 5L4.8-3.8H-4.8z",
];
const DASHES = [null, "6 4", "2 4", "9 3 2 3"];
const HUES = 6; // as many as the stylesheet has

/** Ticks at round numbers that cover low to high, about `wanted` of them. */
export function ticks(low, high, wanted) {
  const rough = (high - low || Math.abs(high) || 1) / wanted;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((each) => each * power >= rough * 0.999) * power;
  const first = Math.floor(low / step + 1e-9);
  const last = Math.max(Math.ceil(high / step - 1e-9), first + 1);
  return Array.from({ length: last - first + 1 }, (_, i) => Number(((first + i) * step).toPrecision(12)));
}

/** Draw into `box`. Series: {name, hue, marker, dash, points: [{x, y, note}]}; `keys` stand in the legend, where an
 * absent hue, marker or dash means any; `format` writes a value of y. */
export function drawChart(box, { label, xLabel, series, keys, fromZero, format }) {
  const width = Math.max(box.clientWidth, 240);
  const points = series.flatMap((each) => each.points.map((point) => ({ ...point, of: each })));
  points.sort((a, b) => a.x - b.x);
  const scale = scaleOf(points, width, fromZero);
  const readout = h("p", { class: "readout", "aria-live": "polite", hidden: "" });
  const ring = svg("circle", { class: "ring", r: 8, visibility: "hidden" });
  const picture = svg(
    "svg",
    { viewBox: `0 0 ${width} ${HEIGHT}`, width, height: HEIGHT, role: "img", tabindex: 0, "data-key": label,
      "aria-label": `${label}: ${count(points.length)} points. The arrow keys read them one by one.` },
    ...axes(scale, width, xLabel, format),
    ...series.map((each) => line(each, scale)),
    ...points.map((point) => marker(point, scale)),
    ring,
  );
  follow(picture, points, scale, ring, (point) => show(readout, point, scale, width, format));
  return [legend(keys), h("div", { class: "plot" }, picture, readout)];
}

function scaleOf(points, width, fromZero) {
  const xs = points.map((point) => point.x);
  const ys = points.map((point) => point.y);
  const near = 2 * Math.min(...xs) > Math.max(...xs) && new Set(xs).size > 1; // else the axis starts at no labels
  const xTicks = ticks(near ? Math.min(...xs) : 0, Math.max(...xs), width < 420 ? 4 : 6);
  const yTicks = ticks(fromZero ? 0 : Math.min(...ys), Math.max(...ys), 5);
  const along = (value, all, from, to) => from + ((value - all[0]) / (all.at(-1) - all[0])) * (to - from);
  return {
    xTicks,
    yTicks,
    x: (value) => along(value, xTicks, MARGIN.left, width - MARGIN.right),
    y: (value) => along(value, yTicks, HEIGHT - MARGIN.bottom, MARGIN.top),
  };
}

function axes(scale, width, xLabel, format) {
  const bottom = HEIGHT - MARGIN.bottom;
  const rows = scale.yTicks.flatMap((value) => [
    svg("line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: scale.y(value), y2: scale.y(value) }),
    svg("text", { class: "tick", x: MARGIN.left - 8, y: scale.y(value) + 4, "text-anchor": "end" }, format(value)),
  ]);
  const columns = scale.xTicks.map((value) =>
    svg("text", { class: "tick", x: scale.x(value), y: bottom + 17, "text-anchor": "middle" }, count(value)));
  const name = svg("text", { class: "axis-name", x: (MARGIN.left + width - MARGIN.right) / 2, y: HEIGHT - 6, "text-anchor": "middle" }, xLabel);
  return [...rows, ...columns, name];
}

function line(series, scale) {
  const path = series.points.map((point, i) => `${i ? "L" : "M"}${scale.x(point.x).toFixed(1)} ${scale.y(point.y).toFixed(1)}`).join("");
  return svg("path", { class: `line hue-${series.hue % HUES}`, d: path, "stroke-dasharray": DASHES[series.dash % DASHES.length] });
}

function marker(point, scale) {
  const place = `translate(${scale.x(point.x).toFixed(1)} ${scale.y(point.y).toFixed(1)})`;
  return svg("path", { class: `point hue-${point.of.hue % HUES}`, d: MARKERS[point.of.marker % MARKERS.length], transform: place });
}

function legend(keys) {
  const entry = (each) => {
    const hue = each.hue == null ? "hue-any" : `hue-${each.hue % HUES}`;
    const stroke = svg("path", { class: `line ${hue}`, d: "M1 7H27", "stroke-dasharray": DASHES[(each.dash ?? 0) % DASHES.length] });
    const shape = each.marker == null ? null : svg("path", { class: `point ${hue}`, d: MARKERS[each.marker % MARKERS.length], transform: "translate(14 7)" });
    const swatch = svg("svg", { width: 28, height: 14, "aria-hidden": "true" }, ...[stroke, shape].filter(Boolean));
    return h("li", {}, swatch, h("span", {}, each.name));
  };
  return h("ul", { class: "legend" }, ...keys.map(entry));
}

function show(readout, point, scale, width, format) {
  readout.hidden = !point;
  if (!point) return;
  readout.replaceChildren(h("strong", {}, format(point.y)), ` ${point.of.name}`, h("br"), `${count(point.x)} labels, ${point.note}`);
  const x = scale.x(point.x);
  readout.style.top = `${scale.y(point.y)}px`;
  readout.style.left = `${x}px`;
  readout.dataset.side = x > width / 2 ? "left" : "right";
}

function follow(picture, points, scale, ring, tell) {
  let at = -1;
  const mark = (index) => {
    at = index;
    const point = points[at];
    ring.setAttribute("visibility", point ? "visible" : "hidden");
    if (point) ring.setAttribute("transform", `translate(${scale.x(point.x)} ${scale.y(point.y)})`);
    tell(point);
  };
  picture.addEventListener("pointermove", (event) => {
    const frame = picture.getBoundingClientRect();
    const far = (point) => Math.hypot(scale.x(point.x) - event.clientX + frame.left, scale.y(point.y) - event.clientY + frame.top);
    mark(points.reduce((best, point, i) => (best < 0 || far(point) < far(points[best]) ? i : best), -1));
  });
  picture.addEventListener("pointerleave", () => mark(-1));
  picture.addEventListener("blur", () => mark(-1));
  picture.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (event.key === "Escape") mark(-1);
    if (!step || !points.length) return;
    event.preventDefault();
    mark((at + step + points.length + (at < 0 && step < 0 ? 1 : 0)) % points.length);
  });
}
