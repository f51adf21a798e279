// Which project is shown, and the polling that keeps it up to date.

import { get, list, Refused, Unreachable, useKey } from "./api.js";
import { drawCompare, drawCurves } from "./curves.js";
import { byId, code, h, redraw, refreshTimes } from "./dom.js";
import { askStrip, drawStrip } from "./filmstrip.js";
import * as sections from "./sections.js";

const POLL_MS = 1000 * Number(document.body.dataset.pollSeconds);
const MAX_WAIT_MS = 30_000;
const PROJECTS_EVERY = 5; // polls between two listings of all projects
const SHOWN = { jobs: 20, rounds: 50, events: 30 };

const state = { projects: null, polls: 0, failures: 0, answers: null, timer: 0, controller: null };

/** The address keeps the choice: #project=ID&compare=ID,ID */
function choice() {
  const params = new URLSearchParams(location.hash.slice(1));
  const project = params.get("project");
  const compare = (params.get("compare") ?? "").split(",").filter((id) => id && id !== project);
  return { project, compare: [...new Set(compare)] };
}

const addressOf = (project, compare) => `#project=${encodeURIComponent(project)}${compare.length ? `&compare=${compare.map(encodeURIComponent).join(",")}` : ""}`;

/** Events come oldest first: large pages up to the newest, then small ones from the last cursor on. */
async function askProject(signal) {
  const { project, compare } = choice();
  const curve = (id) => get("model-error", { project: id }, signal);
  const [about, own, rounds, jobs, events, ...others] = await Promise.all([
    get(`projects/${encodeURIComponent(project)}`, {}, signal),
    curve(project),
    get("rounds", { project, limit: SHOWN.rounds }, signal),
    get("jobs", { project, limit: SHOWN.jobs }, signal),
    get("events", { project, newest: true, limit: SHOWN.events }, signal),
    ...compare.map((id) => curve(id).catch((error) => { if (error instanceof Refused) return { project: id, points: [] }; throw error; })),
  ]);
  const strip = await askStrip(about, events.items, signal);
  return { about, own, others, strip, rounds: rounds.items, jobs: jobs.items, events: events.items };
}

async function ask(signal) {
  if (!state.projects || state.polls % PROJECTS_EVERY === 0) state.projects = await list("projects", {}, signal);
  state.polls += 1;
  if (!choice().project && state.projects.length) history.replaceState(null, "", addressOf(state.projects[0].id, []));
  state.answers = choice().project ? await askProject(signal) : null;
}

function draw() {
  const { project, compare } = choice();
  const projects = state.projects ?? [];
  sections.drawProjects(projects, project, (id) => addressOf(id, compare.filter((each) => each !== id)));
  byId("project").hidden = !state.answers;
  byId("notice").hidden = Boolean(state.answers) || !state.projects;
  if (!state.answers) return void notice();
  const { about, own, others, strip, rounds, jobs, events } = state.answers;
  const advice = sections.curveAdvice(about, rounds);
  const known = (id) => projects.find((each) => each.id === id);
  const compared = others.map((each) => ({ name: known(each.project)?.name ?? each.project.slice(0, 8), points: each.points, family: known(each.project)?.family }));
  document.title = `${about.name} – ASIM`;
  sections.drawHead(about);
  sections.drawRound(about, rounds, jobs);
  sections.drawLabels(about);
  sections.drawError(own.points, advice, about.family);
  drawCurves([{ name: about.name, points: own.points, family: about.family }, ...compared], advice);
  drawCompare(projects.filter((each) => each.id !== project), compare, toggle);
  drawStrip(strip);
  sections.drawRounds(rounds, about);
  sections.drawJobs(jobs);
  sections.drawEvents(events);
}

function notice(text) {
  redraw(byId("notice"), [text ?? null], () =>
    text ? h("p", {}, text) : [
      h("h2", {}, "No project yet"),
      h("p", {}, "Create one with ", code("POST /projects"), ", then upload trajectories with ", code("POST /trajectories"), ". It appears here by itself."),
    ]);
}

function toggle(id, wanted) {
  const { project, compare } = choice();
  const others = compare.filter((each) => each !== id);
  history.replaceState(null, "", addressOf(project, wanted ? [...others, id] : others));
  poll();
}

/** What a failed poll means for the reader. What was drawn before stays. */
function explain(error) {
  if (error instanceof Unreachable) {
    state.failures += 1;
    byId("banner-text").textContent = `${error.message}, retrying. What is shown may be out of date.`;
    byId("banner").hidden = false;
    connection("away", "no answer");
    if (!state.answers && state.projects) notice("Waiting for the service to answer about this project.");
  } else if (error instanceof Refused && (error.status === 401 || error.status === 403)) {
    byId("key-form").hidden = false;
    connection("away", "key needed");
  } else if (error instanceof Refused) {
    state.answers = null;
    draw();
    notice(`The service refuses this project: ${error.message} Choose another one from the list.`);
    connection("live", "live");
  } else throw error;
}

function connection(kind, text) {
  byId("connection").dataset.state = kind;
  byId("connection").textContent = text;
}

function answered() {
  state.failures = 0;
  byId("banner").hidden = true;
  byId("key-form").hidden = true;
  connection("live", "live");
  draw();
}

async function poll() {
  clearTimeout(state.timer);
  state.controller?.abort();
  const { signal } = (state.controller = new AbortController());
  try {
    await ask(signal);
    if (!signal.aborted) answered();
  } catch (error) {
    if (signal.aborted) return;
    explain(error);
  } finally {
    if (!signal.aborted && !document.hidden) state.timer = setTimeout(poll, Math.min(POLL_MS * 2 ** state.failures, MAX_WAIT_MS));
  }
  refreshTimes();
}

function pause() {
  clearTimeout(state.timer);
  state.controller?.abort();
  if (document.hidden) connection("paused", "paused");
  else poll();
}

function listen() {
  addEventListener("hashchange", () => {
    state.answers = null;
    poll();
  });
  document.addEventListener("visibilitychange", pause);
  addEventListener("resize", () => state.answers && draw());
  byId("retry").addEventListener("click", poll);
  byId("skip").addEventListener("click", (event) => {
    event.preventDefault();
    byId("main").focus();
  });
  byId("key-form").addEventListener("submit", (event) => {
    event.preventDefault();
    useKey(byId("key").value.trim());
    byId("key").value = "";
    poll();
  });
}

listen();
poll();
