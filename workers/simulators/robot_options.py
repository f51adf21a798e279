"""What can be chosen of a simulated robot task."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from workers.simulators.base import OptionError

NAMES = ("task", "cameras", "horizon")
LONGEST = 10**6


@dataclass(frozen=True)
class RobotOptions:
    """`cameras` chooses what is observed: two images and proprioception, or proprioception and the objects' poses.
    `horizon` is in steps; an episode is truncated there."""

    task: str
    cameras: bool
    horizon: int

    @classmethod
    def parse(cls, simulator: str, horizons: Mapping[str, int], options: Mapping[str, object]) -> "RobotOptions":
        """Options by name; `horizons` gives the simulator's tasks and the default horizon of each. The first task is
        the default one. Raises OptionError for an unknown option or a value out of range."""
        unknown = [name for name in options if name not in NAMES]
        if unknown:
            raise OptionError(
                f"Simulator {simulator!r} has no option {unknown[0]!r}; its options are {', '.join(NAMES)}."
            )
        task: Any = options.get("task", next(iter(horizons)))
        if not isinstance(task, str) or task not in horizons:
            raise OptionError(f"Option 'task' must be one of {', '.join(horizons)}, but it is {task!r}.")
        cameras, horizon = options.get("cameras", True), options.get("horizon")
        if not isinstance(cameras, bool):
            raise OptionError(f"Option 'cameras' must be true or false, but it is {cameras!r}.")
        if horizon is None:
            horizon = horizons[task]
        if type(horizon) is not int or not 1 <= horizon <= LONGEST:
            raise OptionError(f"Option 'horizon' must be an integer from 1 to {LONGEST}, but it is {horizon!r}.")
        return cls(task, cameras, horizon)
