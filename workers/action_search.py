"""Labels by search: the box action that leads from one recorded state to the next, found by stepping a simulator.

Levenberg-Marquardt on the robot's motion after the step, with slopes by finite differences in the simulator and the
action's numbers held where they meet their bounds. One pose after a step does not tell actions apart, positions and
velocities of all joints do, but where motors give all they have or a target is out of reach.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workers.recording import Recording
from workers.simulators.base import SearchableSimulator, State
from workers.simulators.search_settings import HAND

Vector = NDArray[np.float64]
NUDGE = 0.02  # of an action, for a slope
CLOSE = 1e-3  # in units of `motion`: 0.01 mrad, 0.1 mrad/s, 5 micrometres
LITTLE = 1e-3  # an improvement by less than this part of the error ends a search
STARTS, ITERATIONS, DAMPINGS = 3, 8, 4
SPREAD = 0.7  # of the starts that are drawn: inside the box, where slopes lead somewhere


class Found(NamedTuple):
    """The best action, and how far its replay ended from what was observed, in the simulator's verifying stream."""

    action: NDArray[np.float32]
    residual: float


@dataclass
class _Point:
    action: Vector
    error: Vector  # (m,)

    @property
    def cost(self) -> float:
        return float(self.error @ self.error)


class ActionSearch:
    """Searches in one simulator. Where a start leads nowhere the next ones are drawn, the same in every search."""

    def __init__(self, simulator: SearchableSimulator) -> None:
        self._simulator, self._settings = simulator, simulator.search

    def find(self, recording: Recording, step: int, start: Vector) -> Found:
        """The action of a step, from a guess (n,) on; the first within tolerance, or the best of all starts."""
        before, target = recording.state(step), self._motion(recording.state(step + 1))
        observed = recording.observed(step + 1)[self._settings.stream]
        others = np.random.default_rng(0).uniform(-SPREAD, SPREAD, (STARTS - 1, len(start)))
        best = Found(start.astype(np.float32), np.inf)
        for first in (start, *others):
            point = self._descend(before, target, self._gripped(before, target, first))
            found = self._verified(before, point.action, observed)
            best = found if found.residual < best.residual else best  # a residual that is no number is never less
            if best.residual <= self._settings.tolerance:
                break
        return best

    def _motion(self, state: State) -> Vector:
        self._simulator.restore(state)
        return self._simulator.motion()

    def _reach(self, before: State, target: Vector, action: Vector) -> _Point:
        self._simulator.restore(before)
        self._simulator.advance(action.astype(np.float32))
        return _Point(action, self._simulator.motion() - target)

    def _gripped(self, before: State, target: Vector, start: Vector) -> _Point:
        """The start with the grip that brings the hand nearest."""
        points = [self._reach(before, target, np.array([*start[:-1], grip])) for grip in self._settings.grips]
        return min(points, key=lambda point: float(np.abs(point.error[-HAND:]).sum()))

    def _descend(self, before: State, target: Vector, point: _Point) -> _Point:
        damping = 1e-3
        for _ in range(ITERATIONS):
            if np.abs(point.error).max() < CLOSE:
                break
            slopes = self._slopes(before, target, point)
            for _ in range(DAMPINGS):
                reached = self._reach(before, target, moved(point.action, point.error, slopes, damping))
                damping = damping / 10 if reached.cost < point.cost else damping * 10
                if reached.cost < point.cost:
                    break
            else:
                break
            is_little = reached.cost > (1 - LITTLE) * point.cost
            point = reached
            if is_little:
                break
        return point

    def _slopes(self, before: State, target: Vector, point: _Point) -> Vector:
        """(m, continuous)."""
        columns = []
        for place in range(self._settings.continuous):
            nudge = NUDGE if point.action[place] < 1 - NUDGE else -NUDGE
            nudged = point.action.copy()
            nudged[place] += nudge
            columns.append((self._reach(before, target, nudged).error - point.error) / nudge)
        return np.stack(columns, axis=1)

    def _verified(self, before: State, action: Vector, observed: NDArray[np.float32]) -> Found:
        self._simulator.restore(before)
        self._simulator.advance(action.astype(np.float32))
        reached = self._simulator.numbers()[self._settings.stream]
        return Found(action.astype(np.float32), float(np.abs(reached.astype(np.float64) - observed).max()))


def moved(action: Vector, error: Vector, slopes: Vector, damping: float) -> Vector:
    """One step of Levenberg-Marquardt within the box from -1 to 1; numbers at a bound that press outward stay."""
    count = slopes.shape[1]
    gradient, curvature = slopes.T @ error, slopes.T @ slopes
    near, pressing = action[:count], -gradient
    free = ~(((near <= -1) & (pressing < 0)) | ((near >= 1) & (pressing > 0)))
    square = curvature[np.ix_(free, free)]
    damped = square + damping * np.diag(np.diag(square)) + 1e-9 * np.eye(int(free.sum()))
    result = action.copy()
    result[:count][free] += np.clip(np.linalg.solve(damped, pressing[free]), -1, 1)
    return np.clip(result, -1, 1)
