"""Kinds of rooms, and what the figures of prediction train on and test in each of them."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from benchmarks.paper.minigrid.datasets import (
    ACTIONS,
    TUNING,
    DataSpec,
    draw_labels,
    draw_test_labels,
    load,
    load_states,
)
from models.segments import SegmentBatch
from workers.simulators.base import Simulator, State
from workers.simulators.catalog import make_simulator

Draw = Literal["balanced", "uniform"]
DRAWS: tuple[Draw, ...] = ("balanced", "uniform")
POOL, BALANCED_POOL, TESTING = 300_001, 300_002, 300_003  # added to the first seed: rooms of these figures alone
TRANSITIONS = 12_000  # of the pool at natural frequency
EACH = 600  # effective transitions of each action in the balanced pool
MOST = 1_000_000  # transitions after which a balanced draw gives up


@dataclass(frozen=True)
class Room:
    """`size` counts the walls."""

    size: int = 6
    objects: int = 3
    noisy_tiles: int = 0

    @property
    def name(self) -> str:
        """For the names of files."""
        return f"{self.size}-{self.objects}-{self.noisy_tiles}"

    def simulator(self) -> Simulator:
        """That draws such rooms."""
        return make_simulator("minigrid", self._data("balanced", 1, TUNING).options)

    def labeled(self, draw: Draw, labels: int, seed: int, first: int, folder: Path) -> SegmentBatch:
        """`labels` transitions of a pool that all seeds share; with one seed a smaller set is part of a larger one.

        uniform: each transition of a pool at natural frequency is as likely as any other, no-ops too. balanced:
        effective ones, as many of each action. Raises ValueError for more labels than the pool can give.
        """
        most = TRANSITIONS if draw == "uniform" else EACH * ACTIONS
        if labels > most:
            raise ValueError(f"labels must be at most {most} where they are drawn {draw}, got {labels}.")
        rng = np.random.default_rng(seed)
        if draw == "uniform":
            pool = load(self._data("mixture", TRANSITIONS, first + POOL), folder)
            return draw_labels(pool.take(torch.from_numpy(rng.permutation(pool.size)[:labels])), rng)
        pool = load(replace(self._data("balanced", MOST, first + BALANCED_POOL), per_action=EACH), folder)
        assert pool.actions is not None
        actions = pool.actions[:, 0].numpy()  # effective: each step's set is its action alone
        orders = [rng.permutation(np.flatnonzero(actions == action)) for action in range(ACTIONS)]
        chosen = np.concatenate([order[:share] for order, share in zip(orders, labels_of_each(labels), strict=True)])
        return pool.take(torch.from_numpy(chosen))

    def test(self, per_action: int, first: int, folder: Path) -> tuple[SegmentBatch, list[State]]:
        """Effective transitions, as many of each action, and the simulator's state before each."""
        spec = replace(self._data("balanced", MOST, first + TESTING), per_action=per_action, states=True)
        return draw_test_labels(load(spec, folder)), load_states(spec, folder)

    def _data(self, behavior: str, transitions: int, seed: int) -> DataSpec:
        return DataSpec(behavior, transitions, seed, 0, self.size, self.objects, self.noisy_tiles)


def labels_of_each(labels: int) -> list[int]:
    """So many of each action, the first actions one more where they do not divide."""
    return [labels // ACTIONS + (action < labels % ACTIONS) for action in range(ACTIONS)]
