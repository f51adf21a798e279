"""Rollouts: a behavior acts in a simulator to the end of an episode. Nothing is stored."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from workers.simulators.base import Behavior, Observation, Simulator


class Rollout(NamedTuple):
    """What was looked at before each action, the actions, and whether they solved the task."""

    seen: list[Observation]
    actions: list[Any]
    is_solved: bool


def rollout(
    simulator: Simulator,
    behavior: Behavior,
    seed: int,
    rng: np.random.Generator,
    look: Callable[[], Observation] = dict,
    on_step: Callable[[], None] = lambda: None,
) -> Rollout:
    """The episode of a simulator's seed. look: what to keep of each state. on_step: may raise to stop."""
    simulator.reset(seed)
    behavior.reset(rng)
    seen, actions = list[Observation](), list[Any]()
    while True:
        seen.append(look())
        actions.append(behavior.act(simulator, rng))
        step = simulator.step(actions[-1])
        on_step()
        if step.terminated or step.truncated:
            return Rollout(seen, actions, step.terminated)
