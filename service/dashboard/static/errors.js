// What a model error is called and how it reads: a loss in nats, or of robots the share of change that is not foreseen.

import { digits, figure, h, percent, table, words } from "./dom.js";

const GRID = { name: "loss", unit: "nats a transition, lower is better", text: digits, axis: figure };
const ROBOT = {
  name: "not foreseen",
  unit: "share of what changes that is not foreseen, lower is better",
  text: percent,
  axis: (value) => `${figure(100 * value)} %`,
};

/** The loss of a family's projects; `text` writes it in a table, `axis` beside a chart. */
export const lossOf = (family) => (family === "robot" ? ROBOT : GRID);

/** Squared errors by stream and horizon, beside those of a prediction that nothing moves. */
export function openLoopTable(error, round) {
  const rows = error.open_loop.flatMap((each) => Object.entries(each.errors).map(([stream, value]) =>
    [`${words(stream)}, ${each.horizon} steps`, digits(value), digits(each.standing_still[stream])]));
  return table(["squared error", "open loop", "standing still"], rows, `Open-loop errors of round ${round}`);
}

/** The same, folded under the share that is left at the end of a segment. */
export function openLoopDetails(round) {
  const error = round.model_error;
  if (!error?.open_loop.length) return "–";
  return h("details", { "data-key": `open loop ${round.number}` }, h("summary", {}, `to step ${error.open_loop.at(-1).horizon}`), openLoopTable(error, round.number));
}
