// The parts of the page, each drawn from API answers.

import { badge, byId, code, count, duration, empty, h, percent, plural, redraw, table, when, words } from "./dom.js";
import { lossOf, openLoopDetails, openLoopTable } from "./errors.js";

const WORKING = ["queued", "training", "scoring"];
const NO_FAMILY = "No model family takes this project's spaces: it keeps data and labels, and trains nothing.";
const EVENT_TEXT = 160; // characters shown of one event's data

/** The list of projects; `href(id)` is the address that chooses one. */
export function drawProjects(projects, chosen, href) {
  const data = [projects.map((each) => [each.id, each.name, each.budget.spent]), chosen, location.hash];
  redraw(byId("projects"), data, () => {
    if (!projects.length) return h("li", {}, empty("No project yet. Create one: ", code("POST /projects")));
    return projects.map((each) =>
      h("li", {}, h("a", { href: href(each.id), "data-key": each.id, "aria-current": each.id === chosen ? "true" : null },
        h("span", { class: "name" }, each.name), h("span", { class: "hint" }, plural(each.budget.spent, "label")))));
  });
}

/** Name, environment and labeling policy of a project. */
export function drawHead(project) {
  const { environment, policy } = project;
  byId("project-name").textContent = project.name;
  const segments = `segments of ${plural(project.segment_length, "transition")}`;
  const every = policy.round_labels ? `a round every ${plural(policy.round_labels, "new label")}` : "rounds by hand";
  const rounds = project.family ? every : "no model family";
  byId("project-about").textContent =
    [environment.simulator ?? "own robot", `strategy ${words(policy.strategy)}`, segments, rounds].join(" · ");
}

/** The current round and, if there is one, the round at work or the one that failed or was cancelled last. */
export function drawRound(project, rounds, jobs) {
  const current = rounds.find((round) => round.id === project.current_round);
  const latest = rounds[0];
  const news = latest && latest.id !== current?.id && [...WORKING, "failed", "cancelled"].includes(latest.status) ? latest : null;
  const job = news && jobs.find((each) => each.id === news.job);
  redraw(byId("round"), [current, news, job?.state, job?.progress, job?.message, project.policy.round_labels, project.counts.labeled > 0], () => {
    if (!latest) return firstRound(project);
    return [
      current ? currentRound(current) : empty("No round is current yet."),
      news && workingRound(news, job),
    ];
  });
}

function firstRound(project) {
  if (!project.family) return empty(NO_FAMILY);
  const every = project.policy.round_labels;
  const own = every ? ` A round starts by itself every ${count(every)} new pool labels.` : "";
  if (!project.counts.labeled) return empty("No round yet. Take segments with ", code("POST /acquire"), " and label them with ", code("POST /labels"), ".", own);
  return empty("No round yet. Start one with ", code("POST /rounds"), ".", own);
}

function currentRound(round) {
  return h("div", {},
    h("p", { class: "big" }, count(round.number), " ", badge(round.status)),
    h("p", { class: "hint" }, `${plural(round.labels, "label")}, `, round.finished_at ? when(round.finished_at) : when(round.created_at)),
    warnings(round));
}

// Where the round's diagnostics say that the method does not hold.
function warnings(round) {
  const sentences = round.diagnostics?.warnings ?? [];
  return sentences.length ? h("ul", { class: "warnings", "aria-label": `Warnings of round ${round.number}` }, ...sentences.map((each) => h("li", {}, each))) : null;
}

function workingRound(round, job) {
  const done = round.stages.map((stage) => h("li", {}, h("span", {}, words(stage.name)), h("span", { class: "hint" }, duration(stage.seconds))));
  return h("div", { class: "working" },
    h("p", {}, `Round ${round.number} `, badge(round.status)),
    h("p", { class: "hint" }, plural(round.labels, "label")),
    job?.state === "running" ? progress(job.progress, `Round ${round.number}`) : null,
    done.length ? h("ul", { class: "stages" }, ...done) : null,
    round.error ? h("p", { class: "error" }, round.error) : null);
}

function progress(value, label) {
  return h("div", { class: "progress" }, h("progress", { max: 1, value, "aria-label": `${label}: progress` }), h("span", { class: "num" }, `${Math.floor(100 * value)} %`));
}

/** Pool counts as a segmented bar, the label budget, and the held-out split. */
export function drawLabels(project) {
  const { counts, budget } = project;
  redraw(byId("labels"), [counts, budget], () => [
    h("p", { class: "big" }, count(budget.spent), h("span", { class: "of" }, budget.total == null ? " spent, no budget set" : ` of ${count(budget.total)} spent`)),
    budget.total == null ? null : h("p", { class: "hint" }, `${count(budget.reserved)} reserved, ${count(budget.remaining)} left`),
    budget.total == null ? null : segments("Label budget", budget.total, [["labeled", budget.spent, "spent"], ["leased", budget.reserved, "reserved"], ["unlabeled", budget.remaining, "left"]], false),
    counts.pool_segments ? pool(counts) : empty("The pool is empty. Upload trajectories with ", code("POST /trajectories"), " or let a simulator make them with ", code("POST /collections"), "."),
    h("p", { class: "hint" }, `Held out: ${count(counts.held_out_labeled)} of ${plural(counts.held_out_segments, "segment")} labeled`),
  ]);
}

function pool(counts) {
  const parts = [["labeled", counts.labeled, "labeled"], ["leased", counts.leased, "leased"], ["unlabeled", counts.unlabeled, "unlabeled"]];
  return h("div", {}, h("p", { class: "hint" }, `Pool: ${plural(counts.pool_segments, "segment")} in ${plural(counts.pool_trajectories, "trajectory").replace("trajectorys", "trajectories")}`),
    segments("Pool", counts.pool_segments, parts, true));
}

function segments(name, total, parts, legend) {
  const text = parts.map(([, value, word]) => `${count(value)} ${word}`).join(", ");
  const bar = h("div", { class: "segments", role: "img", "aria-label": `${name}: ${text}` });
  for (const [kind, value] of parts) {
    if (!value) continue;
    const part = h("span", { class: `segment ${kind}` });
    part.style.flexGrow = String(value / total);
    bar.append(part);
  }
  const key = ([kind, value, word]) => h("li", {}, h("span", { class: `dot ${kind}` }), h("span", { class: "num" }, count(value)), ` ${word}`);
  return legend ? h("div", {}, bar, h("ul", { class: "bar-legend", "aria-hidden": "true" }, ...parts.map(key))) : bar;
}

/** Why there is no learning curve yet, and what to do about it. */
export function curveAdvice(project, rounds) {
  const { counts } = project;
  if (!project.family) return NO_FAMILY;
  if (rounds.some((round) => WORKING.includes(round.status)) && counts.held_out_labeled) return "No model error yet: the first point appears when the round has been evaluated.";
  if (!counts.held_out_labeled) return "No model error yet: upload held-out labels, then start a round.";
  if (!counts.labeled) return "No model error yet: label segments of the pool, then start a round.";
  return "No model error yet: start a round, or add labels until one starts by itself.";
}

/** The model error of the newest point of the curve, overall and by action group; of robots open-loop errors too. */
export function drawError(points, advice, family) {
  const last = points.at(-1);
  redraw(byId("error"), [last, advice, family], () => {
    if (!last) return empty(advice);
    const error = last.model_error;
    const loss = lossOf(family);
    const rows = [["overall", error], ...Object.entries(error.by_group)].map(([name, each]) => [words(name), loss.text(each.loss), percent(each.dynamics_accuracy), percent(each.inverse_accuracy)]);
    return [
      table(["", loss.name, "dynamics", "inverse"], rows, "Test loss, dynamics accuracy and inverse accuracy by action group"),
      h("p", { class: "hint" }, `Round ${last.number}, on ${plural(error.transitions, "held-out transition")}`),
      error.open_loop.length ? openLoopTable(error, last.number) : null,
    ];
  });
}

/** Rounds, newest first. */
export function drawRounds(rounds, project) {
  redraw(byId("rounds"), [rounds, project.policy.round_labels, project.counts.labeled > 0], () => {
    if (!rounds.length) return firstRound(project);
    const loss = lossOf(project.family);
    const robots = rounds.some((round) => round.model_error?.open_loop.length);
    const row = (round) => [
      round.number, h("span", {}, badge(round.status), round.error ? h("span", { class: "error" }, ` ${round.error}`) : null),
      count(round.labels), loss.text(round.model_error?.loss), percent(round.model_error?.dynamics_accuracy), ...(robots ? [openLoopDetails(round)] : []),
      round.finished_at ? duration((new Date(round.finished_at) - new Date(round.created_at)) / 1000) : "–", when(round.created_at),
    ];
    const heads = ["round", "status", "labels", loss.name, "dynamics", ...(robots ? ["open loop"] : []), "took", "asked for"];
    return table(heads, rounds.map(row), "Rounds, newest first");
  });
}

/** Jobs, newest first. */
export function drawJobs(jobs) {
  const item = (job) => h("li", { class: "job" },
    h("p", { class: "job-head" }, h("span", { class: "name" }, words(job.kind)), badge(job.state), h("span", { class: "hint" }, when(job.finished_at ?? job.started_at ?? job.created_at))),
    job.state === "running" ? progress(job.progress, words(job.kind)) : null,
    h("p", { class: "hint" }, [`attempt ${job.attempts} of ${job.max_attempts}`, job.message].filter(Boolean).join(" · ")),
    job.error ? h("p", { class: "error" }, job.error) : null);
  redraw(byId("jobs"), jobs, () =>
    jobs.length ? h("ul", { class: "rows", tabindex: 0, "data-key": "jobs", "aria-label": "Jobs, newest first" }, ...jobs.map(item)) : empty("No jobs yet. Collections, rounds and scoring appear here as they run."));
}

function dataText(data) {
  const value = (each) => (typeof each === "string" ? each.replace(/^([0-9a-f]{8})[0-9a-f-]{24,}$/, "$1…") : JSON.stringify(each));
  const text = Object.entries(data).map(([name, each]) => `${words(name)} ${value(each)}`).join(", ");
  return text.length > EVENT_TEXT ? `${text.slice(0, EVENT_TEXT)}…` : text;
}

/** Events, newest first. */
export function drawEvents(events) {
  const item = (event) => h("li", { class: "event" },
    h("p", { class: "job-head" }, h("span", { class: "name" }, words(event.kind)), event.actor ? h("span", { class: "actor" }, `by ${event.actor}`) : null, h("span", { class: "hint" }, when(event.created_at))),
    Object.keys(event.data).length ? h("p", { class: "hint" }, dataText(event.data)) : null);
  redraw(byId("events"), events, () =>
    events.length ? h("ul", { class: "rows", tabindex: 0, "data-key": "events", "aria-label": "Events, newest first" }, ...events.map(item)) : empty("Nothing has happened yet. Uploads, acquisitions, labels and rounds appear here."));
}
