// Elements and words. Text reaches the page as text nodes only, never as markup.

const SVG = "http://www.w3.org/2000/svg";

function build(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) if (value != null) element.setAttribute(name, value);
  element.append(...children.filter((child) => child != null).map((child) => (child instanceof Node ? child : String(child))));
  return element;
}

/** An HTML element; children are elements, or values that become text. */
export const h = (tag, attributes = {}, ...children) => build(document.createElement(tag), attributes, children);

/** An SVG element. */
export const svg = (tag, attributes = {}, ...children) => build(document.createElementNS(SVG, tag), attributes, children);

export const byId = (id) => document.getElementById(id);

const drawn = new WeakMap();

/** Redraw `container` if `data` changed since the last time. By their data-key the element in focus keeps the focus, and
 * details that were unfolded stay so. */
export function redraw(container, data, draw) {
  const print = JSON.stringify(data);
  if (drawn.get(container) === print) return;
  drawn.set(container, print);
  const focused = container.contains(document.activeElement) ? document.activeElement.dataset.key : undefined;
  const unfolded = new Set([...container.querySelectorAll("details[open]")].map((each) => each.dataset.key));
  container.replaceChildren(...[draw()].flat().filter((child) => child != null));
  for (const each of container.querySelectorAll("details[data-key]")) each.open = unfolded.has(each.dataset.key);
  if (focused) [...container.querySelectorAll("[data-key]")].find((each) => each.dataset.key === focused)?.focus();
}

const COUNT = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
export const count = (value) => COUNT.format(value);
export const plural = (value, noun) => `${count(value)} ${noun}${value === 1 ? "" : "s"}`;
export const words = (name) => String(name).replaceAll(/[._]/g, " ");
export const percent = (value) => (value == null ? "–" : `${(100 * value).toFixed(1)} %`);
export const digits = (value) => (value == null ? "–" : value >= 100 ? count(value) : value.toPrecision(3));
export const figure = (value) => (value == null ? "–" : value >= 100 ? count(value) : Number(value.toPrecision(3)).toString());

/** A length of time in words. */
export function duration(seconds) {
  if (seconds < 90) return `${figure(seconds)} s`;
  if (seconds < 3600) return `${Math.round(seconds / 60)} min`;
  return `${Math.floor(seconds / 3600)} h ${Math.round((seconds % 3600) / 60)} min`;
}

const RELATIVE = new Intl.RelativeTimeFormat("en", { numeric: "auto" });
const UNITS = [["day", 86400], ["hour", 3600], ["minute", 60]];

function ago(moment) {
  const seconds = Math.min((moment - Date.now()) / 1000, 0); // clocks differ; nothing happened in the future
  for (const [unit, size] of UNITS) if (Math.abs(seconds) >= size) return RELATIVE.format(Math.trunc(seconds / size), unit);
  return "just now";
}

/** A <time> that `refreshTimes` keeps up to date. */
export function when(timestamp) {
  const moment = new Date(timestamp);
  return h("time", { datetime: timestamp, title: moment.toLocaleString() }, ago(moment));
}

export function refreshTimes() {
  for (const each of document.querySelectorAll("time[datetime]")) {
    const text = ago(new Date(each.dateTime));
    if (each.textContent !== text) each.textContent = text;
  }
}

export const badge = (state) => h("span", { class: "badge", "data-state": state }, words(state));
export const empty = (...children) => h("p", { class: "empty-line" }, ...children);
export const code = (text) => h("code", {}, text);

/** A table that scrolls by itself where it is too wide; each row begins with its name. */
export function table(heads, rows, caption) {
  const cells = (row) => row.map((cell, i) => (i ? h("td", {}, cell) : h("th", { scope: "row" }, cell)));
  return h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": caption, "data-key": caption },
    h("table", {}, h("caption", { class: "unseen" }, caption),
      h("thead", {}, h("tr", {}, ...heads.map((head) => h("th", { scope: "col" }, head)))),
      h("tbody", {}, ...rows.map((row) => h("tr", {}, ...cells(row))))));
}
