// The learning curve: which series the two charts show, and the choices beside them.

import { drawChart } from "./chart.js";
import { byId, figure, h, redraw, words } from "./dom.js";
import { lossOf } from "./errors.js";

const hidden = new Set(); // action groups whose accuracy is not wanted

/** Names of the action groups that any of the curves reports, "overall" first. */
function groupsOf(curves) {
  const named = curves.flatMap((curve) => curve.points.flatMap((point) => Object.keys(point.model_error.by_group)));
  return ["overall", ...new Set(named)];
}

function pointsOf(curve, value) {
  return curve.points
    .map((point) => ({ x: point.labels, y: value(point.model_error), note: `round ${point.number}` }))
    .filter((point) => point.y != null);
}

function lossSeries(curves) {
  return curves.map((curve, i) => ({ name: curve.name, hue: i, marker: i, dash: 0, points: pointsOf(curve, (error) => error.loss) }));
}

// With one project the groups differ by colour; with several, colour names the project and the dash the group.
function accuracySeries(curves, groups) {
  const alone = curves.length === 1;
  return curves.flatMap((curve, i) =>
    groups.map((group, j) => ({ group, j })).filter(({ group }) => !hidden.has(group)).map(({ group, j }) => ({
      name: alone ? words(group) : `${curve.name}, ${words(group)}`,
      hue: alone ? j : i,
      marker: alone ? j : i,
      dash: j,
      points: pointsOf(curve, (error) => (group === "overall" ? error : error.by_group[group])?.dynamics_accuracy),
    })));
}

// Alone, each group is a series of its own; compared, projects and groups are told apart separately.
function accuracyKeys(curves, groups, series) {
  if (curves.length === 1) return series;
  const projects = curves.map((curve, i) => ({ name: curve.name, hue: i, marker: i, dash: 0 }));
  const shown = groups.map((group, j) => ({ name: words(group), dash: j, group })).filter(({ group }) => !hidden.has(group));
  return [...projects, ...shown];
}

/** Draw both charts; curves: [{name, points, family}], the chosen project first: losses of another kind are left out. */
export function drawCurves(curves, emptyText) {
  const some = curves.some((curve) => curve.points.length > 0);
  const groups = groupsOf(curves);
  const without = curves.slice(1).filter((curve) => !curve.points.length).map((curve) => curve.name);
  const loss = lossOf(curves[0].family);
  const alike = curves.filter((curve) => lossOf(curve.family) === loss);
  const unlike = curves.filter((curve) => curve.points.length && !alike.includes(curve)).map((curve) => curve.name);
  const other = unlike.length ? `The loss of ${unlike.join(", ")} is of another kind.` : "";
  byId("loss-unit").textContent = loss.unit;
  const gaps = [curves[0].points.length ? "" : emptyText, other, without.length ? `No model error yet in ${without.join(", ")}.` : ""];
  byId("curve-empty").textContent = gaps.filter(Boolean).join(" ");
  byId("curve-empty").hidden = !byId("curve-empty").textContent;
  document.querySelector(".charts").hidden = !some;
  drawGroups(groups, some, () => drawCurves(curves, emptyText));
  if (!some) return;
  const losses = lossSeries(alike).filter((each) => each.points.length);
  draw("chart-loss", { label: "Test loss", series: losses, keys: losses, fromZero: true, format: loss.axis });
  const share = (value) => `${figure(100 * value)} %`;
  const accuracy = accuracySeries(curves, groups).filter((each) => each.points.length);
  const keys = accuracyKeys(curves, groups, accuracy);
  draw("chart-accuracy", { label: "Dynamics accuracy", series: accuracy, keys, fromZero: false, format: share });
}

function draw(id, chart) {
  const box = byId(id);
  redraw(box, [chart.series, chart.keys, box.clientWidth], () =>
    chart.series.length ? drawChart(box, { ...chart, xLabel: "labels" }) : h("p", { class: "empty-line" }, "Nothing to draw yet."));
}

function drawGroups(groups, some, again) {
  byId("groups").hidden = !some || groups.length < 2;
  const choice = (group) => {
    const box = h("input", { type: "checkbox", "data-key": group });
    box.checked = !hidden.has(group);
    box.addEventListener("change", () => {
      hidden[box.checked ? "delete" : "add"](group);
      again();
    });
    return h("label", {}, box, h("span", {}, words(group)));
  };
  redraw(byId("groups"), groups, () => [h("legend", {}, "Accuracy of"), ...groups.map(choice)]);
}

/** The checkbox list of the other projects; `chosen` is told a project's id and whether it is to be shown. */
export function drawCompare(projects, shown, chosen) {
  byId("compare").hidden = projects.length === 0;
  const choice = (project) => {
    const box = h("input", { type: "checkbox", "data-key": project.id });
    box.checked = shown.includes(project.id);
    box.addEventListener("change", () => chosen(project.id, box.checked));
    return h("label", {}, box, h("span", {}, project.name));
  };
  const data = [projects.map((project) => [project.id, project.name]), shown];
  redraw(byId("compare"), data, () => [h("legend", {}, "Compare with"), ...projects.map(choice)]);
}
