"""Figure 4a: which inverse dynamics infers actions that it has not seen on these objects.

    python -m benchmarks.paper.minigrid.inverse_accuracy --seeds 5 --labels 203 466 1556

Trained on the pairs of object and action that the compositional split shows (`composition`), tested on those that it
holds out. Labels are drawn balanced by action or uniformly.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import nan
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from benchmarks.figures import Figure, finish
from benchmarks.paper import charts
from benchmarks.paper.minigrid import composition, foreign
from benchmarks.paper.minigrid.datasets import ACTIONS, REPORTED, TUNING
from benchmarks.paper.runs import Json, add_options, results, run_missing
from benchmarks.paper.statistics import estimate
from models.chance import training_generator
from models.diagnostic_warnings import unknown_actions
from models.diagnostics import known_actions
from models.families import GRID
from models.inverse_dynamics.base import DiscreteInverseDynamics
from models.segments import SegmentBatch
from models.training import train
from workers.simulators.minigrid_rules import ACTION_NAMES

FORMS: dict[str, tuple[str, dict[str, Any]]] = {
    "sparse": ("inverse_dynamics", {}),
    "masked_cells": ("masked_inverse_dynamics", {"over": "cells"}),
    "masked_latent": ("masked_inverse_dynamics", {"over": "latent"}),
    "dense": ("dense_inverse_dynamics", {}),
}
Draw = Literal[composition.Draw, "given"]  # given: a file's labels
TRAINING, TESTING = 100_000, 200_000  # added to the first seed: rooms of figure 4a alone
TARGETED = "sparse"  # the form that a project trains by default
TARGETS = {"pickup": 0.98, "drop": 0.98, "toggle": 0.98, "swap": 0.90}


@dataclass(frozen=True)
class AccuracyRun:
    """One inverse dynamics from one training set. test_set, seed_set: files in the foreign layout instead of ours."""

    form: str
    draw: Draw
    labels: int
    seed: int
    folder: Path
    tuning: bool = False
    per_action: int = 500
    test_set: Path | None = None
    seed_set: Path | None = None

    @property
    def name(self) -> str:
        """Of its file."""
        rooms = "tuning" if self.tuning else "reported"
        files = [foreign.digest(path) for path in (self.seed_set, self.test_set) if path is not None]
        return "-".join((self.form, self.draw, str(self.labels), str(self.seed), rooms, *files))

    def results(self) -> Json:
        """Accuracy by action, how much the mask keeps, and what a service would say with the test held out."""
        labeled, test = self.labeled(), self.test()
        model = self.trained(labeled)
        right = inferred_right(model, test)
        known = known_actions(labeled.explanations(ACTIONS), test.explanations(ACTIONS), right)
        return {"form": self.form, "draw": self.draw, "labels": self.labels, "seed": self.seed} | {
            "accuracy": by_action(right, test),
            "kept": float(model.kept(test.observations).double().mean()),
            "coordinates": model.coordinates,
            "warnings": list(unknown_actions(known, ACTION_NAMES)),
        }

    def trained(self, labeled: SegmentBatch) -> DiscreteInverseDynamics:
        """A new model, trained."""
        kind, config = FORMS[self.form]
        generator = training_generator(self.seed, 1, kind)
        model: DiscreteInverseDynamics = GRID.build(kind, composition.SPACES, config, generator)  # type: ignore[assignment]  # the kind says so
        train(model, labeled, GRID.training_config(kind, labeled.size), generator)
        return model

    def _first(self) -> int:
        return TUNING if self.tuning else REPORTED

    def labeled(self) -> SegmentBatch:
        """What it trains on."""
        if self.seed_set is not None:
            return foreign.read(self.seed_set)
        assert self.draw != "given"
        return composition.training_set(self._first() + TRAINING + self.seed, self.labels, self.draw, self.folder)

    def test(self) -> SegmentBatch:
        """What it is tested on."""
        if self.test_set is not None:
            return foreign.read(self.test_set)
        return composition.test_set(self._first() + TESTING, self.per_action, self.folder)


@torch.inference_mode()
def inferred_right(model: DiscreteInverseDynamics, test: SegmentBatch) -> Tensor:
    """Whether the action of each labeled step is inferred: bool (B, 1)."""
    assert test.actions is not None
    return model.infer(test.observations) == test.actions


def by_action(right: Tensor, test: SegmentBatch) -> dict[str, float | None]:
    """Share of the steps under each action that are right, None where there is none."""
    chosen = [right[test.actions == action].double() for action in range(ACTIONS)]
    return {name: float(each.mean()) if len(each) else None for name, each in zip(ACTION_NAMES, chosen, strict=True)}


def main(argv: Sequence[str] | None = None) -> list[Figure]:
    """Run what is missing, print the table, draw the chart; the figures with their targets."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_options(parser, "4a")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--labels", type=int, nargs="+", default=[203, 466, 1556])
    parser.add_argument("--draws", nargs="+", choices=("balanced", "uniform"), default=["balanced", "uniform"])
    parser.add_argument("--test-set", type=Path, help="npz in the foreign layout (foreign.py) in place of our test")
    parser.add_argument("--seed-set", type=Path, help="npz in the foreign layout in place of our labels")
    asked = parser.parse_args(argv)
    if asked.seed_set is not None:  # one set, however it was drawn
        asked.draws, asked.labels = ["given"], [foreign.read(asked.seed_set).size]
    runs = [
        AccuracyRun(
            form, draw, labels, seed, asked.out / "data", asked.tuning, test_set=asked.test_set, seed_set=asked.seed_set
        )
        for form, draw, labels, seed in product(FORMS, asked.draws, asked.labels, range(asked.seeds))
    ]
    run_missing(runs, asked.out, asked.processes, asked.threads)
    found = results(runs, asked.out)
    print_table(found)
    print_warnings(found)
    draw_chart(found, asked.out / "4a.png")
    return figures(found, max(asked.labels))


def print_table(found: Sequence[Json]) -> None:
    """Mean accuracy by action, with its 95 % interval, for every form, draw and number of labels."""
    print(" | ".join(("form", "draw", "labels", *ACTION_NAMES, "read", "of")))
    for (form, draw, labels), group in grouped(found).items():
        accuracy = [_cell([each["accuracy"][action] for each in group]) for action in ACTION_NAMES]
        kept = estimate([each["kept"] for each in group]).mean
        print(" | ".join((form, draw, str(labels), *accuracy, f"{kept:.1f}", str(group[0]["coordinates"]))))


def print_warnings(found: Sequence[Json]) -> None:
    """What a service would say of the sparse form's labels if the test were held out there, and with how many seeds."""
    for (form, draw, labels), group in grouped(found).items():
        said = dict[str, list[str]]()  # by what comes before the colon: figures differ by seed
        for sentence in [each for result in group for each in result["warnings"]] if form == TARGETED else []:
            said.setdefault(sentence.partition(":")[0], []).append(sentence)
        for sentences in said.values():
            print(f"{draw}, {labels} labels, {len(sentences)} of {len(group)} seeds: {sentences[0]}")


def grouped(found: Sequence[Json]) -> dict[tuple[str, str, int], list[Json]]:
    """By form, draw and labels; the seeds of each together."""
    groups = dict[tuple[str, str, int], list[Json]]()
    for each in found:
        groups.setdefault((each["form"], each["draw"], each["labels"]), []).append(each)
    return groups


def draw_chart(found: Sequence[Json], path: Path) -> None:
    """Bars by action for each form, from the most balanced labels."""
    most = max(each["labels"] for each in found)
    bars = {
        form: [estimate(_known([each["accuracy"][action] for each in group]) or [nan]) for action in ACTION_NAMES]
        for (form, draw, labels), group in grouped(found).items()
        if draw == found[0]["draw"] and labels == most
    }
    charts.bars(bars, ACTION_NAMES, "accuracy on held-out compositions", path)


def figures(found: Sequence[Json], labels: int) -> list[Figure]:
    """Every form on each interaction from the most labels, balanced or given; the target is the sparse form's."""
    told = []
    for (form, draw, count), group in grouped(found).items():
        if draw == "uniform" or count != labels:
            continue
        for action, target in TARGETS.items():
            accuracy = _known([each["accuracy"][action] for each in group])
            if accuracy:
                goal = target if form == TARGETED else None
                told.append(Figure(f"4a_{form}_{action}", estimate(accuracy).mean, "share", goal))
    return told


def _known(accuracy: Sequence[float | None]) -> list[float]:
    """A test that lacks an action tells nothing of it."""
    return [each for each in accuracy if each is not None]


def _cell(accuracy: Sequence[float | None]) -> str:
    known = _known(accuracy)
    return str(estimate(known)) if known else ""


if __name__ == "__main__":
    finish(main())
