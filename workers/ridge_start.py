"""Where a search for an action begins: a ridge regression of the actions of known labels on what they did."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from workers.recording import Known, Recording
from workers.simulators.base import SearchableSimulator

Vector = NDArray[np.float64]
FEWEST, PENALTY = 50, 1e-2  # steps to fit on; of the squared weights
METRES = 100.0  # centimetres are of the size of the other features


class RidgeStart:
    """Guesses actions (n,) within the box; all zeros until it is fitted on steps enough."""

    def __init__(self, simulator: SearchableSimulator, size: int) -> None:
        self._simulator, self._size = simulator, size
        self._weights: Vector | None = None

    def fit(self, known: Iterable[Known]) -> None:
        """Takes fewer than FEWEST steps for none."""
        steps = [(label, step) for label in known for step in range(len(label.actions))]
        if len(steps) < FEWEST:
            return
        features = np.stack([self._features(label.recording, step) for label, step in steps])
        actions = np.array([label.actions[step] for label, step in steps], np.float64)
        square = features.T @ features + PENALTY * np.eye(features.shape[1])
        self._weights = np.linalg.solve(square, features.T @ actions)

    def guess(self, recording: Recording, step: int) -> Vector:
        """The start for a step."""
        if self._weights is None:
            return np.zeros(self._size)
        return np.clip(self._features(recording, step) @ self._weights, -1, 1)

    def _features(self, recording: Recording, step: int) -> Vector:
        """How the arm moved, and how before, in the world and in its joints."""
        motions = []
        for state in (recording.state(step), recording.state(step + 1)):
            self._simulator.restore(state)
            motions.append(self._simulator.motion())
        seen = recording.observations[self._simulator.search.stream][step : step + 2].astype(np.float64)
        return np.concatenate([METRES * (seen[1] - seen[0]), motions[0], motions[1] - motions[0], [1.0]])
