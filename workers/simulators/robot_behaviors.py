"""Behaviors that fit every robot arm."""

import numpy as np
from numpy.typing import NDArray

from workers.simulators.base import Simulator
from workers.simulators.robot_observation import ACTION_SPACE


class RandomBehavior:
    """Actions drawn uniformly from the whole action space, each independent of the one before."""

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing is remembered."""

    def act(self, simulator: Simulator, rng: np.random.Generator) -> NDArray[np.float32]:
        """Reads nothing of the simulator."""
        del simulator
        return rng.uniform(ACTION_SPACE.low, ACTION_SPACE.high).astype(np.float32)
