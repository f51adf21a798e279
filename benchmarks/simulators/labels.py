"""Labels of robot tasks by replay and by search: how many are right, how far the others are off, and what one costs.

    python -m benchmarks.simulators.labels                   200 segments of one step a task, each way
    python -m benchmarks.simulators.labels --segments 20     a quick look

The episodes are those of a collection with the behavior that robots have by default, the labels those of the labeling
worker. A search begins at a guess fitted on KNOWN other labels. Status 1 where a target is missed.
"""

import argparse
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import Figure, finish
from benchmarks.simulators.speed import TASKS, Task
from workers.episodes import Episode, new_episodes
from workers.explainers import Explained, ReplayOrSearch, explainer_of
from workers.recording import Known, Provenance, Recording
from workers.simulators.base import Simulator
from workers.simulators.catalog import make_behavior, make_simulator

BEHAVIOR, SEED, KNOWN = "noisy_expert", 7, 100
FOUND, SIGNS = 0.9, 0.95  # least shares: of segments that a search explains, of right signs of the gripper's number


class Labels(NamedTuple):
    """Actions (N, 7), those of no answer all NaN; residuals (N,); seconds of processor time for one."""

    actions: NDArray[np.float64]
    residuals: NDArray[np.float64]
    seconds: float


class Data:
    """A task's episodes, and the steps drawn of them: `segments` to label, and KNOWN others."""

    def __init__(self, simulator: Simulator, segments: int) -> None:
        behavior, transitions = make_behavior(BEHAVIOR, simulator), 3 * (segments + KNOWN)
        self.episodes = list(new_episodes(simulator, behavior, transitions, SEED))
        steps = [(number, start) for number, each in enumerate(self.episodes) for start in range(each.transitions)]
        order = np.random.default_rng(SEED).permutation(len(steps))
        drawn = [steps[place] for place in order[: segments + KNOWN]]
        self.segments, self._known = drawn[:segments], drawn[segments:]

    def true_actions(self) -> NDArray[np.float64]:
        """(segments, 7)."""
        return np.array([self.episodes[number].actions[start] for number, start in self.segments], np.float64)

    def recordings(self) -> Iterator[Recording]:
        """Of one step each."""
        return (self._recording(*segment) for segment in self.segments)

    def known(self) -> Iterator[Known]:
        """Steps with their actions."""
        for number, start in self._known:
            yield Known(self._recording(number, start), [self.episodes[number].actions[start]])

    def provenance(self, trajectory: str) -> Provenance:
        """What a collection keeps."""
        episode = self.episodes[int(trajectory)]
        return Provenance(episode.states, {"behavior": BEHAVIOR, "seed": episode.seed, "generator": episode.generator})

    def _recording(self, number: int, start: int) -> Recording:
        episode: Episode = self.episodes[number]
        seen = {name: array[start : start + 2] for name, array in episode.observations.items()}
        return Recording(str(number), start, seen, {name: a[start : start + 2] for name, a in episode.states.items()})


def measure(task: Task, segments: int) -> list[Figure]:
    """Both ways."""
    with closing(make_simulator(task.simulator, {"task": task.name, "cameras": False})) as simulator:
        data = Data(simulator, segments)
        explainer = cast(ReplayOrSearch, explainer_of(simulator, data.provenance, data.known))
        replayed, searched = (label(way, data.recordings()) for way in (explainer.explain, explainer.search))
    true = data.true_actions()
    return [*replay_figures(task.name, replayed, true), *search_figures(task.name, searched, true)]


def label(explain: Callable[[Recording, int], Explained], recordings: Iterable[Recording]) -> Labels:
    """The worker's labels of recordings of one step."""
    actions, residuals, began = [], [], time.process_time()
    for recording in recordings:
        found = explain(recording, 0)
        actions.append(found.actions[0] if found.actions else [np.nan] * 7)
        residuals.append(found.residual)
    return Labels(np.array(actions), np.array(residuals), (time.process_time() - began) / len(actions))


def replay_figures(name: str, labels: Labels, true: NDArray[np.float64]) -> list[Figure]:
    """How many labels are the actions taken, to the last bit and with residual 0, and what one costs."""
    equal = int(((labels.actions == true).all(axis=1) & (labels.residuals == 0)).sum())
    return [
        Figure(f"{name}_replay_equal", equal, f"of {len(true)} labels are the actions taken", len(true)),
        Figure(f"{name}_replay_cost", 1e3 * labels.seconds, "ms a label"),
    ]


def search_figures(name: str, labels: Labels, true: NDArray[np.float64]) -> list[Figure]:
    """How many were found, how far they are off, and what one costs."""
    found = ~np.isnan(labels.actions[:, 0])
    off = np.abs(labels.actions[found] - true[found])
    signs = float(np.mean(np.sign(labels.actions[found, 6]) == np.sign(true[found, 6])))
    figures = [
        Figure(f"{name}_search_found", float(found.mean()), "share within the tolerance", FOUND),
        Figure(f"{name}_search_gripper", signs, "share of right signs", SIGNS),
    ]
    for group, columns in (("position", slice(0, 3)), ("rotation", slice(3, 6))):
        for what, number in (("mean", off[:, columns].mean()), ("p95", np.quantile(off[:, columns], 0.95))):
            figures.append(Figure(f"{name}_search_{group}_error_{what}", float(number), "of an action from -1 to 1"))
    return [
        *figures,
        Figure(f"{name}_search_residual_median", float(np.median(labels.residuals[found])), "m or entry of a rotation"),
        Figure(f"{name}_search_residual_max", float(labels.residuals[found].max()), "m or entry of a rotation"),
        Figure(f"{name}_search_cost", 1e3 * labels.seconds, "ms a label"),
    ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--segments", type=int, default=200, help="of one step, a task")
    parser.add_argument("--task", choices=[task.name for task in TASKS], action="append", help="default: all")
    asked = parser.parse_args()
    tasks = [task for task in TASKS if asked.task is None or task.name in asked.task]
    print(f"{asked.segments} steps of episodes of {BEHAVIOR!r} a task; cost in processor time, without cameras")
    finish([figure for task in tasks for figure in measure(task, asked.segments)])


if __name__ == "__main__":
    main()
