"""How far an episode of a robot task is: its steps, and for how many of them in a row its task has been solved."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

HELD = 3  # steps in a row for which a task must be solved: an object that passes through its goal has not arrived
SHAPE, DTYPE = (2,), "int64"


@dataclass
class Progress:
    """`horizon` is in steps. An episode terminates solved, or is truncated at the horizon."""

    horizon: int
    steps: int = 0
    solved: int = 0

    @property
    def terminated(self) -> bool:
        """Whether the task has been solved for long enough."""
        return self.solved >= HELD

    @property
    def truncated(self) -> bool:
        """Whether the time is over."""
        return self.steps >= self.horizon

    def begin(self) -> None:
        """A new episode."""
        self.steps = self.solved = 0

    def advance(self, is_solved: bool) -> None:
        """One more step."""
        self.steps += 1
        self.solved = self.solved + 1 if is_solved else 0

    def read(self) -> NDArray[np.int64]:
        """(2,)."""
        return np.array([self.steps, self.solved], np.int64)

    def write(self, array: NDArray[Any]) -> None:
        """What `read` gave."""
        self.steps, self.solved = array.tolist()
