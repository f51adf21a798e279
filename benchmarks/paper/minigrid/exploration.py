"""Explore mode offline: an arm says where to act and how, the simulator acts, and what it shows is a label.

Arms `explore:RULE`: actions that `cycle` proposes under the round's models. `explore_random:top`: states and actions
drawn uniformly, as a project explores before its first round. Both execute from the pool's states, as the labeling
worker does; an action that changes nothing is a label like any other and counts.
"""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from benchmarks.paper.minigrid.arms import CHANCE
from benchmarks.paper.minigrid.datasets import ACTIONS, TUNING, DataSpec
from benchmarks.paper.minigrid.loop import Experiment, Round
from models.acquisition import EXPLORING, Models
from models.chance import scoring_generator
from models.exploration import STATES, Asked, asked, distinct, explore, looks
from models.exploration_queue import order
from models.segments import Observations, Segment, SegmentBatch, at
from workers.diagnosis import draw_places
from workers.explanation import explain
from workers.simulators.base import Observation, State
from workers.simulators.catalog import make_simulator


@dataclass(frozen=True)
class Exploration(Experiment):
    """An arm in explore mode. spec: of the pool. states: of the simulator, one a segment of the pool."""

    spec: DataSpec = DataSpec("mixture", 1, TUNING)  # noqa: RUF009  # frozen
    states: tuple[State, ...] = ()
    before: set[Asked] = field(default_factory=set)

    def rounds(self) -> Iterator[Round]:
        """Nothing is executed twice where it looks the same."""
        self.before.clear()
        yield from super().rounds()

    def _scores(self, number: int, models: Models) -> Tensor:
        """The pool itself is not scored."""
        return torch.zeros(0)

    def _chosen(
        self, number: int, models: Models, scores: Tensor, free: Tensor, rng: np.random.Generator
    ) -> tuple[Tensor, SegmentBatch]:
        """Where to act, and what was observed there."""
        name = CHANCE if self.arm.strategy == CHANCE else "cycle"
        generator = scoring_generator(self.seed, name, number, self.trajectories, "exploration 0")
        rows, actions = self._drawn(generator) if name == CHANCE else self._proposed(models, generator)
        return rows, self._executed(rows, actions)

    def _drawn(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        count = self.plan.batch_labels
        rows = torch.randint(self.pool.size, (count,), generator=generator)
        return rows, torch.randint(ACTIONS, (count, 1), generator=generator)

    def _proposed(self, models: Models, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        rows = torch.tensor(draw_places(self.pool.size, [], STATES, generator))
        rows = rows[distinct(looks(at(self.pool.take(rows).observations, 0)))]
        now = at(self.pool.take(rows).observations, 0)
        seen = looks(now)
        found = explore(EXPLORING["cycle"], models, now, 1, generator).without(seen, self.before)
        queue = order(self.arm.orders, models, now, found, self.plan.queue_length, generator)
        chosen = found.take(queue[: self.plan.batch_labels])
        self.before.update(map(asked, [seen[state] for state in chosen.states.tolist()], chosen.actions.tolist()))
        return rows[chosen.states], chosen.actions

    def _executed(self, rows: Tensor, actions: Tensor) -> SegmentBatch:
        """The labels (N, 1) with all actions that explain each of them."""
        seen = list[Observation]()
        sets = torch.zeros(len(rows), 1, ACTIONS, dtype=torch.bool)
        with closing(make_simulator("minigrid", self.spec.options)) as simulator:
            for number, (row, action) in enumerate(zip(rows.tolist(), actions[:, 0].tolist(), strict=True)):
                simulator.restore(self.states[row])
                seen.append(simulator.step(action).observation)
                sets[number, 0, explain(simulator, self.states[row], seen[-1])[0]] = True
        names = tuple(Segment(*self.pool.segments[row]) for row in rows.tolist())
        return SegmentBatch(_pairs(at(self.pool.take(rows).observations, 0), seen), actions, sets, names)


def _pairs(before: Observations, after: list[Observation]) -> Observations:
    """x_t (N, ...) and N observations that followed -> (N, 2, ...)."""
    following = {name: torch.from_numpy(np.stack([each[name] for each in after])) for name in before}
    return {name: torch.stack((stream, following[name]), 1) for name, stream in before.items()}
