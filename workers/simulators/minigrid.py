"""The MiniGrid simulator: an object room behind the simulator protocol, its options, and the observation code."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from workers.simulators.base import Action, Observation, OptionError, Simulator, SimulatorError, State, Step
from workers.simulators.minigrid_behaviors import BEHAVIORS, make_behavior
from workers.simulators.minigrid_env import ObjectRoomEnv
from workers.simulators.minigrid_room import TASKS
from workers.simulators.minigrid_rules import (
    ACTION_NAMES,
    AGENT,
    BALL,
    BLUE,
    BOX,
    CHANNEL_SIZES,
    CONTENTS,
    DROP,
    EMPTY,
    FLOOR,
    FORWARD,
    GOAL,
    GREEN,
    GREY,
    INTERACTION,
    KEY,
    LEFT,
    MOVEMENT,
    NOTHING,
    PICKUP,
    PURPLE,
    RED,
    RIGHT,
    SWAP,
    TOGGLE,
    WALL,
    YELLOW,
)

__all__ = [
    "ACTION_NAMES",
    "AGENT",
    "BALL",
    "BEHAVIORS",
    "BLUE",
    "BOX",
    "CHANNEL_SIZES",
    "CONTENTS",
    "DROP",
    "EMPTY",
    "FLOOR",
    "FORWARD",
    "GOAL",
    "GREEN",
    "GREY",
    "INTERACTION",
    "KEY",
    "LEFT",
    "MOVEMENT",
    "NOTHING",
    "PICKUP",
    "PURPLE",
    "RED",
    "RIGHT",
    "SWAP",
    "TASKS",
    "TOGGLE",
    "WALL",
    "YELLOW",
    "MiniGridOptions",
    "MiniGridSimulator",
    "make_behavior",
    "make_simulator",
]


@dataclass(frozen=True)
class MiniGridOptions:
    """What can be chosen of an object room. `room_size` counts the walls, `max_steps` is in steps.
    Raises OptionError for a value out of range."""

    task: str = "any"
    room_size: int = 6
    objects: int = 3
    noisy_tiles: int = 0
    max_steps: int = 120

    def __post_init__(self) -> None:
        if self.task not in (*TASKS, "any"):
            raise OptionError(f"Option 'task' must be one of {', '.join(TASKS)} or any, but it is {self.task!r}.")
        for name, least, most in (
            ("room_size", 6, 8),
            ("objects", 3, 14),
            ("noisy_tiles", 0, 4),
            ("max_steps", 1, 10**6),
        ):
            value = getattr(self, name)
            if type(value) is not int or not least <= value <= most:
                raise OptionError(f"Option {name!r} must be an integer from {least} to {most}, but it is {value!r}.")
        if self.room_size not in (6, 8):
            raise OptionError(f"Option 'room_size' must be 6 or 8, but it is {self.room_size}.")
        if self.objects > 3 and self.room_size != 8:
            raise OptionError(
                f"Option 'objects' must be 3 in a room of size {self.room_size}, but it is {self.objects}."
            )

    @classmethod
    def parse(cls, options: Mapping[str, object]) -> "MiniGridOptions":
        """Options by name. Raises OptionError for an unknown one."""
        known = [field.name for field in fields(cls)]
        unknown = [name for name in options if name not in known]
        if unknown:
            raise OptionError(f"Simulator 'minigrid' has no option {unknown[0]!r}; its options are {', '.join(known)}.")
        return cls(**cast(dict[str, Any], dict(options)))


class MiniGridSimulator:
    """An object room. Observations `grid` (S, S, 3) and `carried` (3,), uint8 codes (object, colour, state); actions
    are the indices of ACTION_NAMES. `terminated` means that the agent has reached the goal, its task solved or not."""

    def __init__(self, options: MiniGridOptions) -> None:
        self.options = options
        arguments = asdict(options)
        self.env = ObjectRoomEnv(size=arguments.pop("room_size"), render_mode="rgb_array", **arguments)

    @property
    def observation_space(self) -> gym.spaces.Dict:
        """`grid` and `carried`."""
        return cast(gym.spaces.Dict, self.env.observation_space)

    @property
    def action_space(self) -> gym.Space[Any]:
        """Discrete(7)."""
        return self.env.action_space

    def reset(self, seed: int) -> Observation:
        """Draws a room, and a task if the option is "any"."""
        return cast(Observation, self.env.reset(seed=seed)[0])

    def state(self) -> State:
        """See `ObjectRoomEnv.state`."""
        return self.env.state()

    def restore(self, state: State) -> None:
        """Raises StateError for a state of another room size or with impossible values."""
        self.env.restore(state)

    def step(self, action: Action) -> Step:
        """Raises SimulatorError for an action that is not an integer from 0 to 6."""
        if not self.env.action_space.contains(action if isinstance(action, int) else np.asarray(action)[()]):
            raise SimulatorError(f"Action must be an integer from 0 to {len(ACTION_NAMES) - 1}, but it is {action!r}.")
        observation, _, terminated, truncated, _ = self.env.step(int(action))
        return Step(observation, terminated, truncated)

    def observe(self) -> Observation:
        """The current observation, in new arrays."""
        return self.env.gen_obs()

    def render(self) -> NDArray[np.uint8]:
        """MiniGrid's picture of the room, (32 S, 32 S, 3); it does not show what is carried."""
        picture = self.env.render()  # type: ignore[no-untyped-call]  # minigrid has no types here
        return cast(NDArray[np.uint8], picture)

    def close(self) -> None:
        """Nothing is held: there is no window."""
        self.env.close()  # type: ignore[no-untyped-call]  # minigrid has no types here


def make_simulator(options: Mapping[str, object]) -> Simulator:
    """An object room with the given options. Raises OptionError for an unknown option or a value out of range."""
    return MiniGridSimulator(MiniGridOptions.parse(options))
