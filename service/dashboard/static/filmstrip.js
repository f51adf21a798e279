// The newest recording of a project with cameras, as a filmstrip. The frames are the service's, the page draws them.

import { bytes, get, Refused } from "./api.js";
import { byId, count, h, redraw } from "./dom.js";
import { arraysOf } from "./npz.js";

const FRAMES = 8;
const SMALLEST = 16; // pixels a side: what is smaller shows nothing to a person, such as a grid's code
const KEPT_MS = 30_000; // while trajectories come in, the newest is another one at every poll

const strips = new Map(); // project id -> {trajectory, cameras, frames, asked}

/** The strip of `project` as it is now; frames are fetched once for each trajectory that is shown. */
export async function askStrip(project, events, signal) {
  const known = strips.get(project.id);
  const { pool_trajectories, held_out_trajectories } = project.counts;
  if (!pool_trajectories && !held_out_trajectories) return null;
  if (known && Date.now() - known.asked < KEPT_MS) return known;
  const trajectory = await newest(project.id, events, known, signal);
  if (!trajectory) return null;
  const strip = trajectory === known?.trajectory ? known : await stripOf(project.id, trajectory, signal);
  strips.set(project.id, { ...strip, asked: Date.now() });
  return strips.get(project.id);
}

async function newest(project, events, known, signal) {
  const added = events.find((event) => event.kind === "trajectory.added");
  if (added) return added.data.trajectory;
  return known?.trajectory ?? (await get("trajectories", { project, limit: 1 }, signal)).items[0]?.id;
}

async function stripOf(project, trajectory, signal) {
  const path = `trajectories/${encodeURIComponent(trajectory)}`;
  try {
    const { streams, transitions } = await get(path, { project }, signal);
    const cameras = Object.keys(streams).filter((name) => isPicture(streams[name])).sort();
    const steps = cameras.length ? chosenSteps(transitions + 1) : [];
    const frame = async (step) => ({ step, arrays: arraysOf(await bytes(`${path}/content`, { project, start: step, length: 0 }, signal)) });
    return { trajectory, cameras, frames: await Promise.all(steps.map(frame)) };
  } catch (error) {
    if (error instanceof Refused) return { trajectory, cameras: [], frames: [] }; // its blob is lost; the rest of the page is not
    throw error;
  }
}

const isPicture = ({ dtype, shape, high }) =>
  dtype === "uint8" && shape.length === 3 && shape[2] === 3 && Math.min(shape[0], shape[1]) >= SMALLEST && high == null;

function chosenSteps(observations) {
  const shown = Math.min(FRAMES, observations);
  return Array.from({ length: shown }, (_, place) => Math.round((place * (observations - 1)) / Math.max(1, shown - 1)));
}

/** A row for each camera, from the first frame to the last; nothing where there is no camera. */
export function drawStrip(strip) {
  byId("recording").hidden = !strip?.cameras.length;
  redraw(byId("strip"), strip?.trajectory ?? null, () => (strip?.cameras ?? []).map((camera) => row(camera, strip.frames)));
  byId("recording-id").textContent = strip?.trajectory.slice(0, 12) ?? "";
}

function row(camera, frames) {
  return h("div", { class: "strip-row", role: "group", "aria-label": camera },
    ...frames.map(({ step, arrays }) => h("figure", {}, picture(arrays[camera], `${camera}, step ${step}`), h("figcaption", {}, `${camera} ${count(step)}`))));
}

function picture({ shape, data }, label) {
  const [, height, width] = shape; // one observation: time first
  const canvas = h("canvas", { width, height, role: "img", "aria-label": label });
  const image = new ImageData(width, height);
  for (let pixel = 0; pixel < width * height; pixel += 1) {
    image.data.set(data.subarray(3 * pixel, 3 * pixel + 3), 4 * pixel);
    image.data[4 * pixel + 3] = 255;
  }
  canvas.getContext("2d").putImageData(image, 0, 0);
  return canvas;
}
