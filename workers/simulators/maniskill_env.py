"""ManiSkill's tasks as we use them: a Panda arm, small steps of the grip point, no renderer of theirs."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from workers.simulators.maniskill_headless import do_without_vulkan
from workers.simulators.robot_packages import load, quiet


@dataclass(frozen=True)
class Task:
    """Horizon in steps, and the environment's attributes that are its objects."""

    horizon: int
    objects: tuple[str, ...]


TASKS = {
    "PullCube": Task(50, ("obj", "goal_region")),
    "PokeCube": Task(100, ("cube", "peg", "goal_region")),
    "LiftPegUpright": Task(150, ("peg",)),
}


def make_env(task: str) -> Any:
    """A ManiSkill environment. Raises SimulatorUnavailable where ManiSkill is not installed."""
    load("mani_skill.envs")
    do_without_vulkan()
    with quiet():
        return gym.make(
            f"{task}-v1",
            num_envs=1,
            robot_uids="panda",  # the one with a camera has its hand turned by 90 degrees, wrong for both pegs
            control_mode="pd_ee_delta_pose",
            sim_backend="physx_cpu",
            render_backend="none",
            obs_mode="none",  # observations are ours
            reward_mode="none",
        ).unwrapped
