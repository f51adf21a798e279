"""Demonstrations: successful episodes of a task's expert, and the segments that a policy learns from."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from models.segments import Segment, SegmentBatch
from workers.policies import Form, look
from workers.recording import stacked
from workers.rollouts import Rollout, rollout
from workers.simulators.base import Action, Behavior, Simulator, SimulatorError
from workers.simulators.catalog import make_behavior
from workers.simulators.robot_behaviors import NoisyBehavior

EXPERT = "expert"
LOUDEST = 0.3  # of the noise; each episode has its own deviation, from none on
FIRST_OTHER = 2**30  # the simulator's seeds of demonstrations are below it; a policy is tried on those from it on
TRIES = 3  # times as many episodes as there are to be demonstrations


class Remembered:
    """Another behavior, of whose episode all actions are remembered as they were meant."""

    def __init__(self, behavior: Behavior) -> None:
        self._behavior = behavior
        self.meant: list[Action] = []

    def reset(self, rng: np.random.Generator) -> None:
        """Begins a new list."""
        self._behavior.reset(rng)
        self.meant = []

    def act(self, simulator: Simulator, rng: np.random.Generator) -> Action:
        """The other behavior's action."""
        self.meant.append(self._behavior.act(simulator, rng))
        return self.meant[-1]


def demonstrate(
    simulator: Simulator, form: Form, count: int, seed: int, on_step: Callable[[int], None] = lambda done: None
) -> list[Rollout]:
    """`count` episodes that the expert solved, decided by the seed; the actions are those that it meant.

    What it does is disturbed by noise, so that it shows how to come back to where it never went by itself (Laskey et
    al. 2017).
    on_step: told how many there are; may raise to stop. Raises SimulatorError where the expert fails too often.
    """
    expert, rng, solved = Remembered(make_behavior(EXPERT, simulator)), np.random.default_rng(seed), list[Rollout]()
    disturbed = NoisyBehavior(expert, LOUDEST)

    def tell() -> None:
        on_step(len(solved))

    for _ in range(TRIES * count):
        at = int(rng.integers(FIRST_OTHER))
        episode = rollout(simulator, disturbed, at, rng, partial(look, simulator, form), tell)
        solved += [episode._replace(actions=expert.meant)] if episode.is_solved else []
        if len(solved) == count:
            return solved
    raise SimulatorError(f"The expert solved {len(solved)} of {TRIES * count} episodes; {count} were asked for.")


def segments(demonstrations: list[Rollout], chunk: int) -> SegmentBatch:
    """One for every action: observations (B, 2, ...) and the actions from the second one on, (B, 1, chunk, D).

    Before its start and after its end an episode is taken to stand still, and its last action to go on.
    """
    observations: dict[str, list[torch.Tensor]] = {name: [] for name in demonstrations[0].seen[0]}
    actions, names = [], []
    for number, episode in enumerate(demonstrations):
        now = np.arange(len(episode.actions))
        before, ahead = np.maximum(now - 1, 0), np.minimum(now[:, None] + np.arange(chunk), now[-1])
        for name, stream in stacked(episode.seen).items():
            observations[name].append(torch.from_numpy(np.stack([stream[before], stream[now]], 1)))
        actions.append(torch.from_numpy(np.stack(episode.actions)[ahead])[:, None])  # (T, chunk, D) -> (T, 1, chunk, D)
        names += [Segment(f"demonstration {number}", int(step)) for step in now]
    seen = {name: torch.cat(parts) for name, parts in observations.items()}
    return SegmentBatch(seen, torch.cat(actions), segments=tuple(names))
