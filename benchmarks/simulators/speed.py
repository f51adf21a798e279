"""Steps a second of a robot task, with and without cameras, and what restoring a state costs and loses."""

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import Figure
from workers.simulators.base import Simulator, State
from workers.simulators.catalog import make_behavior, make_simulator

RUNS, STEPS = 5, 30
LEAST = float(np.finfo(float).tiny)  # an error below it is none


@dataclass(frozen=True)
class Task:
    """A task, and steps a second of processor time below which something is wrong: what was measured before, on a
    machine that other work shares. Without cameras, then with both."""

    simulator: str
    name: str
    numbers_target: float
    images_target: float


TASKS = (
    Task("robosuite", "Lift", 45, 25),
    Task("robosuite", "PickPlaceCan", 45, 20),
    Task("robosuite", "NutAssemblySquare", 45, 25),
    Task("maniskill", "PullCube", 80, 60),
    Task("maniskill", "PokeCube", 80, 60),
    Task("maniskill", "LiftPegUpright", 80, 60),
)


def speeds(task: Task) -> list[Figure]:
    """Medians over RUNS runs of STEPS random steps. Of processor time, as the machine may be shared."""
    figures = []
    for cameras, what, target in ((False, "numbers", task.numbers_target), (True, "images", task.images_target)):
        with closing(make_simulator(task.simulator, {"task": task.name, "cameras": cameras})) as simulator:
            _episode(simulator, 0)  # what is made at the first step
            runs = [_episode(simulator, run) for run in range(RUNS)]
            rate = STEPS / median(cpu for cpu, _ in runs)
            figures.append(Figure(f"{task.name}_{what}", rate, "steps/s of one processor", target))
            if cameras:
                wall = STEPS / median(wall for _, wall in runs)
                figures.append(Figure(f"{task.name}_{what}_by_the_clock", wall, "steps/s"))
    return figures


def replay(task: Task) -> list[Figure]:
    """What a restore costs, and the largest difference between a state and what replaying leads to, in any number of
    the state: every step of an expert's episode, in random order."""
    with closing(make_simulator(task.simulator, {"task": task.name, "cameras": False})) as simulator:
        states, actions = _recorded(simulator)
        worst = 0.0
        for number in np.random.default_rng(0).permutation(len(actions)):
            simulator.restore(states[number])
            simulator.step(actions[number])
            worst = max(worst, _difference(states[number + 1], simulator.state()))
        seconds = median(_timed(partial(simulator.restore, state))[0] for state in states)
    return [
        Figure(f"{task.name}_restore", 1e3 * seconds, "ms", 2, "below"),
        Figure(f"{task.name}_replay_error", worst, f"at most in {len(actions)} steps", LEAST, "below"),
    ]


def _episode(simulator: Simulator, seed: int) -> tuple[float, float]:
    """Seconds of processor and of wall time."""
    simulator.reset(seed)
    behavior, rng = make_behavior("random", simulator), np.random.default_rng(seed)
    actions = [behavior.act(simulator, rng) for _ in range(STEPS)]

    def play() -> None:
        for action in actions:
            simulator.step(action)

    return _timed(play)


def _recorded(simulator: Simulator) -> tuple[list[State], list[NDArray[Any]]]:
    behavior, rng = make_behavior("expert", simulator), np.random.default_rng(0)
    simulator.reset(0)
    behavior.reset(rng)
    states, actions = [simulator.state()], []
    while True:
        actions.append(np.asarray(behavior.act(simulator, rng)))
        step = simulator.step(actions[-1])
        states.append(simulator.state())
        if step.terminated or step.truncated:
            return states, actions


def _difference(one: State, other: State) -> float:
    return max(float(np.abs(one[name].astype(float) - other[name].astype(float)).max()) for name in one)


def _timed(action: Callable[[], object]) -> tuple[float, float]:
    cpu, wall = time.process_time(), time.perf_counter()
    action()
    return time.process_time() - cpu, time.perf_counter() - wall
