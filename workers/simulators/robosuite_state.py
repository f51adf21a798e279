"""Everything that decides a robosuite episode's future, as arrays: what MuJoCo integrates is not all of it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.simulators.base import State, check_finite, check_state
from workers.simulators.robosuite_env import TASKS, seed_env
from workers.simulators.robot_packages import check_version, load, versions
from workers.simulators.robot_progress import Progress
from workers.simulators.search_settings import motion

mujoco: Any = load("mujoco")

mujoco.set_mju_user_warning(lambda message: None)  # `broke_down` tells; else it writes a file to where the process is

INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION
POSTURE, GOAL = slice(0, 7), slice(7, 10)  # the goal's rotation matrix follows
CONTROLLER = 19
OPENING = 0.02  # m of a finger's way for 1 of what the gripper is sent to
PACKAGES = ("robosuite", "mujoco")
NAMES = ("robosuite", "MuJoCo")
BREAKDOWNS = [mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC]


class StateAccess:
    """Reads and writes the state of one environment.

    `physics`: positions, velocities, warm start and the like, MuJoCo's own vector. `gripper` (2,): the position that
    the fingers were sent to, which moves by at most 0.2 a substep. `controller` (19,): resting posture, goal position
    and goal rotation. `progress` (2,): see `Progress`. `version` (7,): number of the task, then the versions of
    robosuite and of MuJoCo. The last two are int64, the others float64.
    """

    def __init__(self, env: Any, task: str, progress: Progress) -> None:
        self._env, self._progress = env, progress
        self._version = np.concatenate([[list(TASKS).index(task)], versions(*PACKAGES)])
        self._model, self._data = env.sim.model._model, env.sim.data._data
        self._size = mujoco.mj_stateSize(self._model, INTEGRATION)

    @property
    def expected(self) -> dict[str, tuple[tuple[int, ...], str]]:
        """Shapes and dtypes, for `check_state`."""
        return {
            "controller": ((CONTROLLER,), "float64"),
            "gripper": ((2,), "float64"),
            "physics": ((self._size,), "float64"),
            "progress": ((2,), "int64"),
            "version": (self._version.shape, "int64"),
        }

    def read(self) -> State:
        """Copies."""
        physics = np.empty(self._size)
        mujoco.mj_getState(self._model, self._data, physics, INTEGRATION)
        arm = self._arm
        controller = np.concatenate([arm.initial_joint, arm.goal_pos, np.ravel(arm.goal_ori)])
        gripper = np.broadcast_to(self._gripper.current_action, 2).astype(np.float64)
        return {
            "controller": controller,
            "gripper": gripper,
            "physics": physics,
            "progress": self._progress.read(),
            "version": self._version.copy(),
        }

    def begin(self, seed: int) -> None:
        """A new episode, drawn by the seed."""
        seed_env(self._env, seed)
        self._gripper.current_action = np.zeros(2)  # robosuite keeps it from the last episode
        self._progress.begin()
        self._env.reset()
        self.write(self.read())

    def write(self, state: State) -> None:
        """Raises StateError for a state of another task or version, or with a number that is none."""
        self._check(state)
        mujoco.mj_resetData(self._model, self._data)  # what is counted, too
        mujoco.mj_setState(self._model, self._data, state["physics"], INTEGRATION)
        self._gripper.current_action = state["gripper"].copy()
        arm, controller = self._arm, state["controller"].copy()
        arm.initial_joint, arm.goal_pos = controller[POSTURE], controller[GOAL]
        arm.goal_ori = controller[GOAL.stop :].reshape(3, 3)
        self._progress.write(state["progress"])
        self._forward()
        arm.update(force=True)

    def broke_down(self) -> bool:
        """Whether a number was not finite since the last reset; MuJoCo itself then starts anew and only counts that."""
        return any(self._data.warning[kind].number for kind in BREAKDOWNS) or not np.isfinite(self._data.qpos).all()

    def motion(self) -> NDArray[np.float64]:
        """(18,): see `search_settings.motion`."""
        robot, data = self._env.robots[0], self._data
        fingers = data.qpos[robot._ref_gripper_joint_pos_indexes["right"]]
        sent = OPENING * np.broadcast_to(self._gripper.current_action, 2)
        return motion(data.qpos[robot._ref_joint_pos_indexes], data.qvel[robot._ref_joint_vel_indexes], fingers, sent)

    def _forward(self) -> None:
        """Derived quantities, without the warm start that computing them leaves behind."""
        warm_start = self._data.qacc_warmstart.copy()
        self._env.sim.forward()
        self._data.qacc_warmstart[:] = warm_start

    def _check(self, state: State) -> None:
        check_state(state, self.expected)
        check_finite(state)
        check_version(state["version"], self._version, list(TASKS), NAMES)

    @property
    def _arm(self) -> Any:
        return self._env.robots[0].composite_controller.part_controllers["right"]

    @property
    def _gripper(self) -> Any:
        return self._env.robots[0].gripper["right"]
