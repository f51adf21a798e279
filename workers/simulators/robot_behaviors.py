"""Behaviors that fit every robot arm."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from workers.simulators.base import Behavior, OptionError, Simulator
from workers.simulators.robot_observation import ACTION_SPACE
from workers.simulators.waypoints import ExpertBehavior, Planner


class RandomBehavior:
    """Actions drawn uniformly from the whole action space, each independent of the one before."""

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing is remembered."""

    def act(self, simulator: Simulator, rng: np.random.Generator) -> NDArray[np.float32]:
        """Reads nothing of the simulator."""
        del simulator
        return rng.uniform(ACTION_SPACE.low, ACTION_SPACE.high).astype(np.float32)


class NoisyBehavior:
    """Another behavior's actions with Gaussian noise on all numbers but the gripper's. An episode's standard deviation
    is drawn uniformly from 0 to `loudest`, so that some episodes go well and some badly."""

    LOUDEST = 0.6

    def __init__(self, behavior: Behavior, loudest: float = LOUDEST) -> None:
        self._behavior, self._loudest, self._deviation = behavior, loudest, 0.0

    def reset(self, rng: np.random.Generator) -> None:
        """Draws how noisy the episode is."""
        self._deviation = float(rng.uniform(0, self._loudest))
        self._behavior.reset(rng)

    def act(self, simulator: Simulator, rng: np.random.Generator) -> NDArray[np.float32]:
        """The other behavior's action and noise, within the action space."""
        action = np.array(self._behavior.act(simulator, rng), np.float32)
        action[:-1] += self._deviation * rng.standard_normal(len(action) - 1)
        return np.clip(action, ACTION_SPACE.low, ACTION_SPACE.high)


_FACTORIES: dict[str, Callable[[Planner], Behavior]] = {
    "expert": ExpertBehavior,
    "noisy_expert": lambda plan: NoisyBehavior(ExpertBehavior(plan)),
    "random": lambda plan: RandomBehavior(),
}
BEHAVIORS = tuple(_FACTORIES)


def make_behavior(name: str, simulator: str, plan: Planner) -> Behavior:
    """The named behavior for a simulator of that name, whose experts go by `plan`. Raises OptionError for an unknown
    name."""
    if name not in _FACTORIES:
        raise OptionError(
            f"Simulator {simulator!r} has no behavior {name!r}; its behaviors are {', '.join(BEHAVIORS)}."
        )
    return _FACTORIES[name](plan)
