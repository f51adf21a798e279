"""Hand-made rooms: the agent in the middle of a room of size 6, facing right."""

import numpy as np

from workers.simulators.catalog import make_simulator
from workers.simulators.minigrid import MiniGridSimulator
from workers.simulators.minigrid_room import TASKS
from workers.simulators.minigrid_rules import GOAL_CODE, NOTHING, WALL_CODE, Code

X, Y = 2, 2


def make(**options: object) -> MiniGridSimulator:
    simulator = make_simulator("minigrid", options)
    assert isinstance(simulator, MiniGridSimulator)
    return simulator


def place(
    simulator: MiniGridSimulator, objects: dict[tuple[int, int], Code], carried: Code = NOTHING, task: str = TASKS[0]
) -> None:
    """Restores a room with the objects at (column, row), after a reset that seeds the generator."""
    simulator.reset(0)
    size = simulator.options.room_size
    state = simulator.state()
    state["cells"][...] = WALL_CODE
    state["cells"][1:-1, 1:-1] = NOTHING
    state["cells"][size - 2, size - 2] = GOAL_CODE
    for (x, y), code in objects.items():
        state["cells"][y, x] = code
    state["carried"][...] = carried
    state["agent"][...] = (X, Y, 0)
    state["task"][...] = TASKS.index(task)
    simulator.restore(state)


def code_at(simulator: MiniGridSimulator, x: int, y: int) -> tuple[int, ...]:
    return tuple(np.asarray(simulator.observe()["grid"])[y, x].tolist())
