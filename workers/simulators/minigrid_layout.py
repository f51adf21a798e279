"""Random object rooms: what lies where when an episode begins."""

import numpy as np

from workers.simulators.minigrid_paths import reach
from workers.simulators.minigrid_room import TASKS, Room
from workers.simulators.minigrid_rules import (
    BALL,
    BLUE,
    BOX,
    FLOOR,
    GOAL_CODE,
    GREY,
    KEY,
    NOTHING,
    RED,
    WALL_CODE,
    Code,
)


def draw_room(rng: np.random.Generator, size: int, task: str, objects: int, noisy_tiles: int) -> Room:
    """A walled room with the goal at the bottom right, the agent anywhere in any direction, objects and floor tiles.

    Three objects are a key, a ball and a box, drawn again until the agent can reach each of them and the goal without
    moving any; more are shared evenly among the three kinds. Every object is red or blue by chance.
    """
    while True:
        room = _draw(rng, size, task, _draw_objects(rng, objects), noisy_tiles)
        needed = {*room.find(KEY), *room.find(BALL), *room.find(BOX), room.goal}
        if objects > 3 or reach(room) >= needed:
            return room


def _draw_objects(rng: np.random.Generator, objects: int) -> list[Code]:
    kinds = [KEY, BALL, BOX] * (objects // 3) + rng.permutation([KEY, BALL, BOX]).tolist()[: objects % 3]
    return [(kind, RED if red else BLUE, 0) for kind, red in zip(kinds, rng.random(objects) < 0.5, strict=True)]


def _draw(rng: np.random.Generator, size: int, task: str, objects: list[Code], noisy_tiles: int) -> Room:
    inner = range(1, size - 1)
    cells = [NOTHING if y in inner and x in inner else WALL_CODE for y in range(size) for x in range(size)]
    goal = (size - 2) * size + size - 2
    cells[goal] = GOAL_CODE
    free = rng.permutation([place for place, code in enumerate(cells) if code == NOTHING]).tolist()
    colors = rng.integers(RED, GREY + 1, noisy_tiles).tolist()
    tiles: list[Code] = [(FLOOR, color, 0) for color in colors]
    for place, code in zip(free, objects + tiles, strict=False):
        cells[place] = code
    position = int(rng.choice(free[len(objects) :]))  # the agent may stand on a tile
    return Room(size, tuple(cells), NOTHING, position, int(rng.integers(4)), task)


def draw_task(rng: np.random.Generator, task: str) -> str:
    """The task itself, or one of the three by chance for "any"; the same number of draws in both cases."""
    drawn = TASKS[int(rng.integers(len(TASKS)))]
    return drawn if task == "any" else task


def flicker(rng: np.random.Generator, colors: list[int], probability: float = 0.25) -> list[int]:
    """Colours of noisy tiles one step later: each changes with the given probability to one of the five others.
    The number of draws depends on the number of tiles only, so that every action sees the same tiles."""
    changes = rng.random(len(colors)) < probability
    shifts = rng.integers(1, GREY + 1, len(colors))
    return [
        (color + int(shift)) % (GREY + 1) if change else color
        for color, change, shift in zip(colors, changes, shifts, strict=True)
    ]
