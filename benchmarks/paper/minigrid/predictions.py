"""Figure 9: what world models predict for each action, in pictures.

    python -m benchmarks.paper.minigrid.predictions --arms random:top cycle:signatures --examples 3

For each action a state in which it is effective; below it what happens, and what the world model of each arm predicts
after its 200 + 3 x 100 labels, those of figure 4d with the same seed. Wrong cells are outlined in red.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure as Picture
from numpy.typing import NDArray

from api_schemas.strategies import DEFAULT_BATCH_RULE, DEFAULT_STRATEGY
from benchmarks.figures import Figure, finish
from benchmarks.paper.minigrid.arms import Arm
from benchmarks.paper.minigrid.changes import changes
from benchmarks.paper.minigrid.datasets import ACTIONS
from benchmarks.paper.minigrid.drawing import draw_observation
from benchmarks.paper.minigrid.loop import Experiment
from benchmarks.paper.minigrid.prediction_accuracy import predicted
from benchmarks.paper.minigrid.rooms import Rooms, add_files
from benchmarks.paper.runs import Json, add_options, results, run_missing
from models.segments import Observations, SegmentBatch, at
from workers.simulators.minigrid_rules import ACTION_NAMES

INCHES = 1.45  # a room in the picture


@dataclass(frozen=True)
class PredictionsRun:
    """One arm's last world model, and what it predicts of the examples."""

    arm: Arm
    seed: int
    examples: int
    rooms: Rooms
    networks: Path

    @property
    def name(self) -> str:
        """Of its file."""
        return "-".join((self.arm.strategy, self.arm.rule, str(self.seed), str(self.examples), *self.rooms.words))

    def results(self) -> Json:
        """Likeliest next observations (N, ...) of the examples, as lists."""
        data = self.rooms.load()
        experiment = Experiment(
            self.arm, self.seed, data.spaces, data.pool, self.networks, seed_set=data.seed_set, video=data.video
        )
        *_, last = experiment.rounds()
        assert last.models.world_model is not None
        shown = self.shown()
        guess = predicted(last.models.world_model, shown)
        correct, changed = changes(guess, shown.observations)
        return {
            "arm": self.arm.name,
            "labels": last.labeled.size,
            "guess": {name: stream.tolist() for name, stream in guess.items()},
            "accuracy": int(correct.sum()) / int(changed.sum()),
        }

    def shown(self) -> SegmentBatch:
        """For each example one effective transition of each action, in the order of the actions."""
        return examples_of(self.rooms.load().tests["balanced"], self.examples)


def examples_of(test: SegmentBatch, examples: int) -> SegmentBatch:
    """Of each action transitions evenly spaced over the test, example by example: (examples * 7,).

    Raises ValueError where the test has too few of an action.
    """
    assert test.actions is not None
    rows = [torch.nonzero(test.actions[:, 0] == action).flatten() for action in range(ACTIONS)]
    short = [ACTION_NAMES[action] for action, of in enumerate(rows) if len(of) < examples]
    if short:
        raise ValueError(f"The test has fewer than {examples} transitions of {', '.join(short)}.")
    spaced = [of[:: len(of) // examples][:examples] for of in rows]
    return test.take(torch.stack(spaced, 1).flatten())


def main(argv: Sequence[str] | None = None) -> list[Figure]:
    """Train what is missing and draw a picture an example. No figure has a target."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_options(parser, "9")
    add_files(parser)
    arms = [Arm("random", "top"), Arm(DEFAULT_STRATEGY, DEFAULT_BATCH_RULE)]
    parser.add_argument("--arms", nargs="+", default=arms, type=Arm.parse)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--examples", type=int, default=3)
    asked = parser.parse_args(argv)
    rooms = Rooms.of(asked)
    runs = [PredictionsRun(arm, asked.seed, asked.examples, rooms, rooms.networks(asked.out)) for arm in asked.arms]
    rooms.load()  # once, before processes ask for it
    run_missing(runs, asked.out, asked.processes, asked.threads)
    found = results(runs, asked.out)
    shown = runs[0].shown()
    guesses = {f"{each['arm']}, {each['labels']} labels": _guess(each["guess"]) for each in found}
    for example in range(asked.examples):
        rows = slice(example * ACTIONS, (example + 1) * ACTIONS)
        of_example = {name: {key: stream[rows] for key, stream in guess.items()} for name, guess in guesses.items()}
        draw_predictions(shown.take(rows), of_example, asked.out / f"9-{example + 1}.png")
    return [Figure(f"9_changes_right_{each['arm']}", each["accuracy"], "share") for each in found]


def draw_predictions(shown: SegmentBatch, guesses: dict[str, Observations], path: Path) -> int:
    """A column a transition, rows: before, what happened, each guess (N, ...). Says how many elements are wrong."""
    truth = at(shown.observations, 1)
    rows = {"before": at(shown.observations, 0), "what happens": truth, **guesses}
    picture = Picture(figsize=(INCHES * shown.size, (INCHES + 0.1) * len(rows)), dpi=120, layout="constrained")
    panels = picture.subplots(len(rows), shown.size, squeeze=False)
    wrong = 0
    for line, (name, observations) in enumerate(rows.items()):
        for column in range(shown.size):
            against = _arrays(truth, column) if name in guesses else None
            wrong += draw_observation(panels[line, column], *_arrays(observations, column), against)
        panels[line, 0].set_ylabel(name.replace(":", "\n").replace(", ", "\n"), fontsize=8)
    assert shown.actions is not None
    for column, action in enumerate(shown.actions[:, 0].tolist()):
        panels[0, column].set_title(ACTION_NAMES[action], fontsize=10)
    picture.savefig(path)
    return wrong


def _guess(told: Json) -> Observations:
    return {name: torch.tensor(stream, dtype=torch.uint8) for name, stream in told.items()}


def _arrays(observations: Observations, row: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    return observations["grid"][row].numpy(), observations["carried"][row].numpy()


if __name__ == "__main__":
    finish(main())
