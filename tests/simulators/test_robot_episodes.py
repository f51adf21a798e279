"""Whole episodes of the robot simulators: experts solve their tasks, and every step of an episode can be replayed."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.figures import Figures
from workers.simulators import maniskill, robosuite
from workers.simulators.base import Simulator, SimulatorUnavailable, State
from workers.simulators.catalog import make_behavior, make_simulator

pytestmark = [pytest.mark.robots, pytest.mark.timeout(900)]

TASKS = dict.fromkeys(robosuite.HORIZONS, "robosuite") | dict.fromkeys(maniskill.HORIZONS, "maniskill")
EPISODES, FIRST_SEED, SHARE = 50, 2000, 0.9  # seeds that no expert was tuned on

REPLAY = """
import sys
import numpy as np
from workers.simulators.catalog import make_simulator
folder, name, task = sys.argv[1:]
simulator = make_simulator(name, {"task": task, "cameras": False})
states, actions = dict(np.load(folder + "/states.npz")), np.load(folder + "/actions.npy")
after = []
for number in range(len(actions)):
    simulator.restore({key: array[number] for key, array in states.items()})
    simulator.step(actions[number])
    after.append(simulator.state())
np.savez(folder + "/after.npz", **{key: np.stack([state[key] for state in after]) for key in states})
"""


@pytest.fixture(params=TASKS)
def task(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def simulator(task: str) -> Iterator[Simulator]:
    try:
        made = make_simulator(TASKS[task], {"task": task, "cameras": False})
    except SimulatorUnavailable as error:
        pytest.skip(str(error))
    with closing(made) as simulator:
        yield simulator


def _expert_episode(simulator: Simulator, seed: int) -> tuple[list[State], list[NDArray[Any]], bool]:
    """States (one more than actions), actions, and whether the task was solved."""
    behavior, rng = make_behavior("expert", simulator), np.random.default_rng(seed)
    simulator.reset(seed)
    behavior.reset(rng)
    states, actions = [simulator.state()], list[NDArray[Any]]()
    while True:
        actions.append(np.asarray(behavior.act(simulator, rng)))
        step = simulator.step(actions[-1])
        states.append(simulator.state())
        if step.terminated or step.truncated:
            return states, actions, step.terminated


def test_an_expert_solves_its_task(simulator: Simulator, task: str, figures: Figures) -> None:
    episodes = [_expert_episode(simulator, FIRST_SEED + number) for number in range(EPISODES)]
    solved = [len(actions) for _, actions, is_solved in episodes if is_solved]
    figures.add(f"{task}: solved of {EPISODES} episodes", len(solved) / EPISODES, "share", SHARE)
    figures.add(f"{task}: steps of a solved episode", float(np.mean(solved)), "steps")


def test_every_step_of_an_episode_is_replayed_exactly_in_another_process(
    simulator: Simulator, task: str, figures: Figures, tmp_path: Path
) -> None:
    states, actions, is_solved = _expert_episode(simulator, 0)
    assert is_solved
    stacked = {name: np.stack([state[name] for state in states]) for name in states[0]}
    np.savez(tmp_path / "states.npz", **cast(Any, stacked))
    np.save(tmp_path / "actions.npy", np.stack(actions))
    subprocess.run([sys.executable, "-c", REPLAY, str(tmp_path), TASKS[task], task], check=True, timeout=300)
    after = np.load(tmp_path / "after.npz")
    worst = max(float(np.abs(after[name].astype(float) - array[1:]).max()) for name, array in stacked.items())
    figures.note(f"{task}: largest difference over {len(actions)} replayed steps: {worst:g}")
    assert worst == 0
