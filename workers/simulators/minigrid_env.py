"""The object room as a gymnasium environment on MiniGrid's own grid, objects and renderer."""

from collections.abc import Mapping
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import WorldObj
from minigrid.minigrid_env import MiniGridEnv
from numpy.typing import NDArray

from workers.simulators.base import Observation, SimulatorError, State, StateError, check_state
from workers.simulators.minigrid_layout import draw_room, draw_task, flicker
from workers.simulators.minigrid_objects import CODES, OBJECTS, PACKED
from workers.simulators.minigrid_room import TASKS, Room
from workers.simulators.minigrid_rules import (
    ACTION_NAMES,
    AGENT,
    BLUE,
    BOX,
    CHANNEL_SIZES,
    CONTENTS,
    FLOOR,
    FORWARD,
    GOAL,
    LEFT,
    RED,
    RIGHT,
    interact,
    is_passable,
)
from workers.simulators.minigrid_tasks import MISSIONS, is_solved

WORD = 2**64 - 1


class ObjectRoomEnv(MiniGridEnv):
    """Keys, balls and boxes in an empty room; seven actions; the observation of `gen_obs`. Reaching the goal ends the
    episode, with a reward if the task is solved by then (`minigrid_tasks`); `max_steps` truncates it."""

    carrying: WorldObj | None  # type: ignore[assignment]  # minigrid infers None from its first value
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        *,
        task: str = "any",
        size: int = 6,
        objects: int = 3,
        noisy_tiles: int = 0,
        max_steps: int = 120,
        render_mode: str | None = None,
    ) -> None:
        """`task` is one of TASKS or "any", drawn at each reset; `size` counts the walls; `max_steps` is in steps."""
        mission_space = MissionSpace(lambda task: MISSIONS[task], [list(TASKS)])
        super().__init__(mission_space, grid_size=size, max_steps=max_steps, render_mode=render_mode, highlight=False)
        self.size, self.task_option, self.objects, self.noisy_tiles = size, task, objects, noisy_tiles
        self.task = TASKS[0]
        self.tiles: list[int] = []
        self.action_space = spaces.Discrete(len(ACTION_NAMES))
        self.observation_space = _observation_space(size)
        self.state_arrays = _state_arrays(size)

    def _gen_grid(self, width: int, height: int) -> None:
        del height  # rooms are square
        task = draw_task(self.np_random, self.task_option)
        self._set_room(draw_room(self.np_random, width, task, self.objects, self.noisy_tiles))

    def _set_room(self, room: Room) -> None:
        self.grid = Grid(self.size, self.size)
        self.grid.grid = [OBJECTS[code] for code in room.cells]
        self.carrying = OBJECTS[room.carried]
        self.agent_pos = (room.position % self.size, room.position // self.size)
        self.agent_dir = room.direction
        self.task, self.mission = room.task, MISSIONS[room.task]
        self.tiles = room.find(FLOOR)

    def step(  # type: ignore[override]  # minigrid leaves observations and actions unbound type variables
        self, action: int
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """One of ACTION_NAMES; raises SimulatorError for any other. Noisy tiles change after the action."""
        if not 0 <= action < len(ACTION_NAMES):
            raise SimulatorError(f"Action must be an integer from 0 to {len(ACTION_NAMES) - 1}, but it is {action}.")
        self.step_count += 1
        terminated = self._act(action)
        if self.tiles:
            self._flicker()
        info = {"is_success": is_solved(self.room())} if terminated else {}
        reward = self._reward() if info.get("is_success") else 0.0
        return self.gen_obs(), reward, terminated, self.step_count >= self.max_steps, info

    def _act(self, action: int) -> bool:
        """Applies the action; says whether the agent has walked onto the goal."""
        if action in (LEFT, RIGHT):
            self.agent_dir = (self.agent_dir + (1 if action == RIGHT else 3)) % 4
            return False
        x, y = self._front()
        item = self.grid.grid[y * self.size + x]
        front = CODES[item]
        if action == FORWARD:
            if is_passable(front):
                self.agent_pos = (x, y)
            return front[0] == GOAL
        placed, carried = interact(action, front, CODES[self.carrying])
        self.grid.grid[y * self.size + x], self.carrying = OBJECTS[placed], OBJECTS[carried]
        return False

    def _front(self) -> tuple[int, int]:
        x, y = self.agent_pos
        right, down = ((1, 0), (0, 1), (-1, 0), (0, -1))[self.agent_dir]
        return x + right, y + down

    def _flicker(self) -> None:
        colors = [CODES[self.grid.grid[tile]][1] for tile in self.tiles]
        for tile, color in zip(self.tiles, flicker(self.np_random, colors), strict=True):
            self.grid.grid[tile] = OBJECTS[FLOOR, color, 0]

    def _cells(self) -> NDArray[np.uint8]:
        packed = bytearray().join([PACKED[item] for item in self.grid.grid])
        return np.frombuffer(packed, np.uint8).reshape(self.size, self.size, 3)

    def gen_obs(self) -> Observation:
        """`grid` uint8 (S, S, 3), axes (row, column), the agent hiding what it stands on; `carried` uint8 (3,)."""
        grid = self._cells()
        x, y = self.agent_pos
        grid[y, x] = (AGENT, RED, self.agent_dir)
        return {"grid": grid, "carried": np.frombuffer(bytearray(PACKED[self.carrying]), np.uint8)}

    def room(self) -> Room:
        """The current state as task definitions read it."""
        cells = tuple(CODES[item] for item in self.grid.grid)
        x, y = self.agent_pos
        return Room(self.size, cells, CODES[self.carrying], y * self.size + x, self.agent_dir, self.task)

    def state(self) -> State:
        """Everything, as arrays: `cells` (S, S, 3) without the agent, `carried` (3,), `agent` (column, row, direction),
        `step_count` (), `task` () its index in TASKS, `generator` (6,) the words of the PCG64 generator."""
        return {
            "cells": self._cells(),
            "carried": np.frombuffer(bytearray(PACKED[self.carrying]), np.uint8),
            "agent": np.array([*self.agent_pos, self.agent_dir], np.int64),
            "step_count": np.array(self.step_count, np.int64),
            "task": np.array(TASKS.index(self.task), np.int64),
            "generator": _generator_words(self.np_random.bit_generator.state),
        }

    def restore(self, state: State) -> None:
        """Goes back to a state. Raises StateError for one of another room size or with impossible values."""
        check_state(state, self.state_arrays)
        self._set_room(_checked_room(state, self.size))
        self.step_count = int(state["step_count"])
        self.np_random.bit_generator.state = _generator_state(state["generator"])


def _observation_space(size: int) -> spaces.Dict:
    high = np.broadcast_to(np.array(CHANNEL_SIZES, np.uint8) - 1, (size, size, 3))
    hand = np.array([BOX, BLUE, len(CONTENTS)], np.uint8)
    grid = spaces.Box(np.zeros_like(high), high, dtype=np.uint8)
    return spaces.Dict({"grid": grid, "carried": spaces.Box(np.zeros_like(hand), hand, dtype=np.uint8)})


def _state_arrays(size: int) -> dict[str, tuple[tuple[int, ...], str]]:
    return {
        "cells": ((size, size, 3), "uint8"),
        "carried": ((3,), "uint8"),
        "agent": ((3,), "int64"),
        "step_count": ((), "int64"),
        "task": ((), "int64"),
        "generator": ((6,), "uint64"),
    }


def _checked_room(state: State, size: int) -> Room:
    x, y, direction = state["agent"].tolist()
    if not (0 < x < size - 1 and 0 < y < size - 1 and 0 <= direction < 4):
        raise StateError(
            f"State 'agent' must be (column, row, direction) inside the walls, but it is {[x, y, direction]}."
        )
    if not 0 <= state["task"] < len(TASKS):
        raise StateError(f"State 'task' must be below {len(TASKS)}, but it is {state['task']}.")
    room = Room.from_state(state)
    unknown = {room.carried, *room.cells} - OBJECTS.keys()
    if unknown:
        raise StateError(f"State 'cells' or 'carried' has the code {min(unknown)}, which stands for no object.")
    if not is_passable(room.cells[room.position]):
        raise StateError(f"The agent of state 'agent' stands on the object {room.cells[room.position]}.")
    return room


def _generator_words(state: Mapping[str, Any]) -> NDArray[np.uint64]:
    value, increment = state["state"]["state"], state["state"]["inc"]
    words = [value >> 64, value & WORD, increment >> 64, increment & WORD, state["has_uint32"], state["uinteger"]]
    return np.array(words, np.uint64)


def _generator_state(array: NDArray[np.uint64]) -> dict[str, Any]:
    words = array.tolist()
    pcg = {"state": words[0] << 64 | words[1], "inc": words[2] << 64 | words[3]}
    return {"bit_generator": "PCG64", "state": pcg, "has_uint32": words[4], "uinteger": words[5]}


def register_environments() -> None:
    """Registers ASIM/MiniGrid-<Task>-<size>x<size>-v0 of each task and room size with gymnasium, once."""
    for task in TASKS:
        for size in (6, 8):
            name = f"ASIM/MiniGrid-{task.title().replace('_', '')}-{size}x{size}-v0"
            if name not in gym.registry:
                entry = f"{__name__}:{ObjectRoomEnv.__name__}"
                gym.register(name, entry_point=entry, kwargs={"task": task, "size": size})


register_environments()
