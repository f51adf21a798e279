"""Figures 4b, 4c and noise: what happens next, by a world model and by the simulator under an inferred action.

    python -m benchmarks.paper.minigrid.prediction --figures 4b 4c noise --seeds 5

The world model is told the true action and predicts. Inverse dynamics sees both observations and infers the action; the
simulator, restored to its state before the step, takes it. Both are held against what was observed, on effective
transitions of other rooms, as many of each action. 4b: more labels. 4c: more objects than the six that were trained on.
noise: more tiles that flicker, in training too.

A restored simulator knows its own chance: tiles flicker under it as they were observed to, whatever the action. So the
noise figure is also given with the tiles masked, and with the simulator's generator exchanged for another moment's.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

from benchmarks.figures import Figure, finish
from benchmarks.paper.minigrid import foreign
from benchmarks.paper.minigrid.datasets import REPORTED, TUNING, grid_spaces
from benchmarks.paper.minigrid.prediction_accuracy import with_simulator, without_simulator
from benchmarks.paper.minigrid.prediction_data import DRAWS, Draw, Room
from benchmarks.paper.runs import Json, add_options, results, run_missing
from models.chance import training_generator
from models.families import GRID
from models.network import Network
from models.segments import SegmentBatch
from models.training import train

FILE = "file"  # names the test that is a file's
FORMS = {"sparse": "inverse_dynamics", "dense": "dense_inverse_dynamics"}
Name = Literal["4b", "4c", "noise"]


@dataclass(frozen=True)
class Point:
    """One place on the axis of a figure."""

    x: int
    labels: int
    trained: Room
    tested: Room


POINTS: dict[Name, list[Point]] = {
    "4b": [Point(labels, labels, Room(), Room()) for labels in (400, 800, 1200, 1600, 2000)],
    "4c": [Point(objects, 2000, Room(8, 6), Room(8, objects)) for objects in (6, 8, 10, 12, 14)],
    "noise": [Point(tiles, 2000, *[Room(noisy_tiles=tiles)] * 2) for tiles in range(5)],
}


@dataclass(frozen=True)
class PredictionRun:
    """A world model and two inverse dynamics of the same labels, in one kind of rooms, tested in one or more."""

    draw: Draw
    labels: int
    seed: int
    trained: Room
    tested: tuple[Room, ...]
    folder: Path
    tuning: bool = False
    per_action: int = 300
    test_set: Path | None = None

    @property
    def name(self) -> str:
        """Of its file."""
        rooms = "tuning" if self.tuning else "reported"
        file = [] if self.test_set is None else [foreign.digest(self.test_set)]
        return "-".join((self.trained.name, self.draw, str(self.labels), str(self.seed), rooms, *file))

    def results(self) -> Json:
        """Dynamics Accuracy of each predictor by test room, and the share of actions inferred right."""
        labeled = self.trained.labeled(self.draw, self.labels, self.seed, self._first(), self.folder)
        world_model: Any = self._network("world_model", labeled)
        inverses: dict[str, Any] = {form: self._network(kind, labeled) for form, kind in FORMS.items()}
        told: Json = {"draw": self.draw, "labels": self.labels, "seed": self.seed, "trained": self.trained.name}
        if self.test_set is not None:
            file = foreign.read(self.test_set)
            return told | {"tests": {FILE: without_simulator(world_model, inverses, file)}}
        tests = {room: room.test(self.per_action, self._first(), self.folder) for room in self.tested}
        return told | {
            "tests": {room.name: with_simulator(world_model, inverses, room, *test) for room, test in tests.items()}
        }

    def _first(self) -> int:
        return TUNING if self.tuning else REPORTED

    def _network(self, kind: str, labeled: SegmentBatch) -> Network:
        generator = training_generator(self.seed, 1, kind)
        network = GRID.build(kind, grid_spaces(self.trained.size), {}, generator)
        train(network, labeled, GRID.training_config(kind, labeled.size), generator)
        return network


def runs_of(
    figures: Sequence[Name],
    draws: Sequence[Draw],
    seeds: int,
    folder: Path,
    tuning: bool = False,
    test_set: Path | None = None,
) -> list[PredictionRun]:
    """Seeds first, so that an unfinished benchmark has all points. Points of the same labels are one run."""
    tested = dict[tuple[int, Room], dict[Room, None]]()
    for point in (point for figure in figures for point in POINTS[figure]):
        tested.setdefault((point.labels, point.trained), {})[point.tested] = None
    return [
        PredictionRun(draw, labels, seed, trained, tuple(rooms), folder, tuning, test_set=test_set)
        for seed, draw, ((labels, trained), rooms) in product(range(seeds), draws, tested.items())
    ]


def main(argv: Sequence[str] | None = None) -> list[Figure]:
    """Run what is missing, print the tables, draw the charts; the figures with their targets."""
    from benchmarks.paper.minigrid.prediction_table import draw_charts, figures_of, print_file_table, print_tables

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_options(parser, "prediction")
    parser.add_argument("--figures", nargs="+", choices=tuple(POINTS), default=tuple(POINTS))
    parser.add_argument("--draws", nargs="+", choices=DRAWS, default=DRAWS)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--test-set", type=Path, help="npz in the foreign layout (foreign.py) in place of our tests")
    asked = parser.parse_args(argv)
    runs = runs_of(asked.figures, asked.draws, asked.seeds, asked.out / "data", asked.tuning, asked.test_set)
    if asked.test_set is not None:
        size = foreign.read(asked.test_set).observations["grid"].shape[2]
        runs = [run for run in runs if run.trained.size == size]
    run_missing(runs, asked.out, asked.processes, asked.threads)
    found = results(runs, asked.out)
    if asked.test_set is not None:
        print_file_table(found, FILE)
        return []
    print_tables(asked.figures, found)
    draw_charts(asked.figures, found, asked.out)
    return figures_of(asked.figures, found)


if __name__ == "__main__":
    finish(main())
