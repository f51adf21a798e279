"""robosuite's tasks as we use them: a Panda arm, operational space control of small steps, no renderer of theirs."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from workers.simulators.robot_packages import load

CONTROL_FREQUENCY = 20  # Hz
BUILD_SEED = 0  # the size of Lift's cube is drawn when the model is built: one model for all episodes and processes


@dataclass(frozen=True)
class Task:
    """Horizon in steps, and the bodies that move."""

    horizon: int
    bodies: tuple[str, ...]


TASKS = {
    "Lift": Task(100, ("cube_main",)),
    "PickPlaceCan": Task(200, ("Can_main",)),
    "NutAssemblySquare": Task(200, ("SquareNut_main",)),
}


def make_env(task: str) -> Any:
    """A robosuite environment. Raises SimulatorUnavailable where robosuite is not installed."""
    load("mujoco")
    robosuite = load("robosuite")
    return robosuite.make(
        task,
        robots="Panda",
        controller_configs=_controller(),
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        use_object_obs=False,  # ours are read from the state
        control_freq=CONTROL_FREQUENCY,
        ignore_done=True,
        hard_reset=False,  # a hard one builds the model anew: 300 ms against 5
        seed=BUILD_SEED,
    )


def seed_env(env: Any, seed: int) -> None:
    """In place: the samplers of initial positions share the environment's generator."""
    env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state


def _controller() -> dict[str, Any]:
    """Actions are steps of the grip point, up to 5 cm and 0.5 rad in each coordinate, from where it is."""
    loaded = load("robosuite.controllers").load_composite_controller_config(controller="BASIC")
    loaded["body_parts"] = {"right": loaded["body_parts"]["right"]}  # the Panda has no other part
    return dict(loaded)
