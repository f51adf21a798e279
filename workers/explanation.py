"""Which actions explain an observed step: found by stepping a simulator, never read from anywhere."""

import gymnasium as gym
import numpy as np

from workers.simulators.base import Observation, Simulator, State


def explain(simulator: Simulator, state: State, observed: Observation) -> tuple[list[int], float]:
    """All discrete actions that lead from `state` to `observed`, and the residual of the best of them.

    The list is empty where even the best one misses; residual is the largest difference in any stream.
    """
    if not isinstance(simulator.action_space, gym.spaces.Discrete):
        raise ValueError(f"action space {simulator.action_space} cannot be tried action by action")
    residuals = [_residual(simulator, state, action, observed) for action in range(int(simulator.action_space.n))]
    return [action for action, residual in enumerate(residuals) if residual == 0.0], min(residuals)


def _residual(simulator: Simulator, state: State, action: int, observed: Observation) -> float:
    simulator.restore(state)
    reached = simulator.step(action).observation
    return max(float(np.abs(reached[name].astype(np.float64) - observed[name]).max()) for name in observed)
