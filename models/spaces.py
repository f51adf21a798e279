"""Observation and action spaces of a project: what a family needs to know to build its networks."""

from dataclasses import dataclass
from typing import Any

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
    """Continuous actions in [low, high] in every coordinate."""

    low: float
    high: float
    shape: tuple[int, ...]


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
        return {"observations": streams, "action": box}

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
            return Spaces(streams, BoxAction(action["low"], action["high"], tuple(action["shape"])))
        raise ValueError(f"action.type must be 'discrete' or 'box', got {action['type']!r}.")
