"""Recordings: what a labeler has of a segment, and of the trajectory that it is in."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from workers.simulators.base import Observation, State

Arrays = dict[str, NDArray[Any]]


def stacked(steps: Sequence[Mapping[str, NDArray[Any]]]) -> Arrays:
    """What was observed, or the states, at T moments: T dicts of arrays (...) to one of arrays (T, ...)."""
    return {name: np.stack([step[name] for step in steps]) for name in steps[0]}


class Provenance(NamedTuple):
    """How a trajectory came about: its states (T + 1, ...), and what is told of the behavior that led through them."""

    states: Arrays
    told: dict[str, object]


Provenances = Callable[[str], Provenance]
"""The provenance of a whole trajectory, by its id."""


@dataclass(frozen=True)
class Recording:
    """L steps from observation `start` of a trajectory on: observations and states (L + 1, ...)."""

    trajectory: str
    start: int
    observations: Arrays
    states: Arrays

    def state(self, step: int) -> State:
        """Before the step; that of `step + 1` is after it."""
        return {name: array[step] for name, array in self.states.items()}

    def observed(self, step: int) -> Observation:
        """Before the step, likewise."""
        return {name: array[step] for name, array in self.observations.items()}


class Known(NamedTuple):
    """A recording whose actions are labeled."""

    recording: Recording
    actions: Sequence[Any]
