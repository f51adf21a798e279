"""Observation and action spaces of a project: what a family needs to know to build its networks."""

import math
from dataclasses import dataclass
from typing import Any

from torch import Tensor

Json = dict[str, Any]


@dataclass(frozen=True)
class StreamSpec:
    """One stream of an observation: its shape without batch and time, and its numpy dtype name."""

    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class DiscreteAction:
    """Actions 0 .. n-1."""

    n: int


@dataclass(frozen=True)
class BoxAction:
    """Continuous actions in [low, high] in every coordinate.

    signs: coordinates of which only the side of the middle counts, as of a gripper that opens or closes.
    """

    low: float
    high: float
    shape: tuple[int, ...]
    signs: tuple[int, ...] = ()

    def unit(self, actions: Tensor) -> Tensor:
        """From the box to [-1, 1]."""
        return (actions.float() - self._middle) / self._half

    def restored(self, unit: Tensor) -> Tensor:
        """The reverse."""
        return self._middle + self._half * unit

    @property
    def _middle(self) -> float:
        return (self.high + self.low) / 2

    @property
    def _half(self) -> float:
        return (self.high - self.low) / 2


@dataclass(frozen=True)
class Spaces:
    """Observation streams by name, and the action space."""

    observations: dict[str, StreamSpec]
    action: DiscreteAction | BoxAction

    def to_json(self) -> Json:
        """Plain JSON values; `from_json` reads them back."""
        streams = {name: {"shape": list(s.shape), "dtype": s.dtype} for name, s in self.observations.items()}
        action = self.action
        if isinstance(action, DiscreteAction):
            return {"observations": streams, "action": {"type": "discrete", "n": action.n}}
        box = {"type": "box", "low": action.low, "high": action.high, "shape": list(action.shape)}
        return {"observations": streams, "action": box | {"signs": list(action.signs)}}

    @staticmethod
    def from_json(value: Json) -> "Spaces":
        """Raises ValueError for an action type that is neither discrete nor box."""
        streams = {
            name: StreamSpec(tuple(stream["shape"]), stream["dtype"]) for name, stream in value["observations"].items()
        }
        action = value["action"]
        if action["type"] == "discrete":
            return Spaces(streams, DiscreteAction(action["n"]))
        if action["type"] == "box":
            shape, signs = tuple(action["shape"]), tuple(action.get("signs", ()))
            return Spaces(streams, BoxAction(action["low"], action["high"], shape, signs))
        raise ValueError(f"action.type must be 'discrete' or 'box', got {action['type']!r}.")


def bounded_box(spaces: Spaces) -> BoxAction:
    """The action space. Raises ValueError, in a sentence, unless it is a bounded box of vectors."""
    box = spaces.action
    if not isinstance(box, BoxAction) or len(box.shape) != 1 or not -math.inf < box.low < box.high < math.inf:
        raise ValueError(f"The robot family takes a bounded box of shape (D,) as action space, got {box}.")
    if any(not 0 <= place < box.shape[0] for place in box.signs):
        raise ValueError(f"signs must be places in an action of {box.shape[0]} numbers, got {box.signs}.")
    return box
