"""Figures 4a and 4d on a file in the foreign layout: the same numbers as on the project's own path.

    python -m benchmarks.paper.minigrid.foreign_path

Takes the steps of the two balanced tests that the layout can hold, writes them as a stranger's file, and tests the same
networks on the steps themselves and on the file.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch

from benchmarks.figures import Figure, finish
from benchmarks.paper.minigrid import foreign
from benchmarks.paper.minigrid.acquisition import BY_ACTION
from benchmarks.paper.minigrid.arms import Arm
from benchmarks.paper.minigrid.datasets import GROUPS
from benchmarks.paper.minigrid.inverse_accuracy import AccuracyRun, by_action, inferred_right
from benchmarks.paper.minigrid.loop import Experiment, Plan, errors
from benchmarks.paper.minigrid.rooms import Rooms
from benchmarks.paper.runs import add_options
from models.segments import SegmentBatch

Numbers = dict[str, float | None]


def main(argv: Sequence[str] | None = None) -> list[Figure]:
    """Both figures both ways; how far apart the numbers are."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_options(parser, "foreign")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--labels", type=int, default=203, help="of figure 4a, balanced")
    asked = parser.parse_args(argv)
    torch.set_num_threads(asked.threads)
    beside = asked.out.parent  # where figures 4a and 4d keep their sets and networks
    rooms = Rooms(beside / "4d" / "data", asked.tuning)
    run = AccuracyRun("sparse", "balanced", asked.labels, asked.seed, beside / "4a" / "data", asked.tuning)
    return [
        *accuracy(run, asked.out / "4a.npz"),
        *errors_of(rooms, asked.seed, rooms.networks(beside / "4d"), asked.out / "4d.npz"),
    ]


def accuracy(run: AccuracyRun, file: Path) -> list[Figure]:
    """Figure 4a: its accuracy by action."""
    test = written(run.test(), file)
    native = by_action(inferred_right(run.trained(run.labeled()), test), test)
    return compared("4a", test, native, replace(run, test_set=file).results()["accuracy"])


def errors_of(rooms: Rooms, seed: int, networks: Path, file: Path, plan: Plan | None = None) -> list[Figure]:
    """Figure 4d: model error after the first round, overall, by group and by action. networks: folder of those kept."""
    data = rooms.load()
    test = written(data.tests["balanced"], file)
    experiment = Experiment(Arm("random", "top"), seed, data.spaces, data.pool, networks, plan or Plan())
    models = next(experiment.rounds()).models
    theirs = replace(rooms, test_set=file).load().tests["balanced"]
    native, foreigners = (errors(models, {"test": each}, GROUPS | BY_ACTION)["test"] for each in (test, theirs))
    return compared("4d", test, *(flat({"overall": each.overall, **each.groups}) for each in (native, foreigners)))


def written(test: SegmentBatch, file: Path) -> SegmentBatch:
    """The steps of the test that the file now holds."""
    kept = test.take(foreign.fits(test).nonzero().flatten())
    file.parent.mkdir(parents=True, exist_ok=True)
    foreign.write(kept, file)
    return kept


def flat(groups: Mapping[str, object]) -> Numbers:
    """Every number of every group by name."""
    return {
        f"{group} {name}": value
        for group, error in groups.items()
        for name, value in asdict(error).items()  # type: ignore[call-overload]  # of dataclasses
    }


def compared(figure: str, test: SegmentBatch, native: Numbers, theirs: Numbers) -> list[Figure]:
    """The largest difference of any number; a number that only one side has counts as endless."""
    assert native.keys() == theirs.keys()
    gaps = [
        0.0 if one == other else float("inf") if one is None or other is None else abs(one - other)
        for one, other in ((native[name], theirs[name]) for name in native)
    ]
    return [
        Figure(f"{figure}_file_transitions", test.size, "transitions"),
        Figure(f"{figure}_file_numbers", sum(value is not None for value in native.values()), "numbers"),
        Figure(f"{figure}_file_largest_difference", max(gaps), "of any number", 1e-9, "below"),
    ]


if __name__ == "__main__":
    finish(main())
