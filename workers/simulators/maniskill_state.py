"""Everything that decides a ManiSkill episode's future, as arrays, and a way for nothing else to decide it.

PhysX remembers more than can be read or written: contact and friction caches, and the order in which pairs of bodies
met. A restored state therefore has another future than the live one had, by up to 3 mm and 4 rad/s after a step in
contact. So the bodies move into an empty PhysX scene after every step and get their state written there: 0.3 ms, and a
step depends on nothing but the arrays below, in whatever order, scene or process.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.simulators.base import State, check_finite, check_state
from workers.simulators.maniskill_env import TASKS
from workers.simulators.robot_packages import check_version, load, versions
from workers.simulators.robot_progress import Progress
from workers.simulators.search_settings import motion

sapien: Any = load("sapien")

PACKAGES = ("mani_skill", "sapien")
NAMES = ("ManiSkill", "SAPIEN")
JOINTS, ARM = 9, 7


class StateAccess:
    """The state of one environment, kept as it was read: reading what was written could differ in the last bit.

    `joints` (3, 9): positions, velocities and drive targets of seven joints and two fingers (rad, m). `objects`
    (n, 13): position, quaternion (w, x, y, z), linear and angular velocity of each object (m, rad, s). `progress` (2,):
    see `Progress`. `version` (7,): number of the task, then the versions of ManiSkill and of SAPIEN. float32 and int64.
    """

    def __init__(self, env: Any, task: str, progress: Progress) -> None:
        self._env, self._progress = env, progress
        self._version = np.concatenate([[list(TASKS).index(task)], versions(*PACKAGES)])
        kind = sapien.physx.PhysxRigidDynamicComponent
        self._bodies = [getattr(env, name)._objs[0].find_component_by_type(kind) for name in TASKS[task].objects]
        self._entities = list(env.scene.sub_scenes[0].entities)
        self._robot = env.agent.robot._objs[0]
        self._timestep = env.scene.px.timestep
        self._state: State = {}

    @property
    def expected(self) -> dict[str, tuple[tuple[int, ...], str]]:
        """Shapes and dtypes, for `check_state`."""
        return {
            "joints": ((3, JOINTS), "float32"),
            "objects": ((len(self._bodies), 13), "float32"),
            "progress": ((2,), "int64"),
            "version": (self._version.shape, "int64"),
        }

    def read(self) -> State:
        """Copies."""
        return {**{name: array.copy() for name, array in self._state.items()}, "progress": self._progress.read()}

    def write(self, state: State) -> None:
        """Raises StateError for a state of another task or version, or with a number that is none."""
        check_state(state, self.expected)
        check_finite(state)
        check_version(state["version"], self._version, list(TASKS), NAMES)
        self._state = {name: array.copy() for name, array in state.items()}
        self._progress.write(state["progress"])
        self._settle()

    def begin(self, seed: int) -> None:
        """A new episode, drawn by the seed."""
        self._env.reset(seed=seed)
        for joint, position in zip(self._robot.active_joints, self._robot.qpos, strict=True):
            joint.set_drive_target(float(position))  # the reset leaves those of the last episode
        self._progress.begin()
        self.follow()

    def follow(self) -> None:
        """Takes over what the simulation has become. Raises StateError where a number is not finite."""
        robot = self._robot
        targets = [joint.drive_target[0] for joint in robot.active_joints]
        joints = np.stack([robot.qpos, robot.qvel, np.ravel(targets)]).astype(np.float32)
        bodies = np.stack([_read(body) for body in self._bodies]).astype(np.float32)
        self._state = {"joints": joints, "objects": bodies, "version": self._version}
        check_finite(self._state)
        self._settle()

    def motion(self) -> NDArray[np.float64]:
        """(18,): see `search_settings.motion`."""
        positions, velocities, targets = self._state["joints"]
        return motion(positions[:ARM], velocities[:ARM], positions[ARM:], targets[ARM:])

    def _settle(self) -> None:
        """Puts the bodies into an empty scene, in the arrangement of the state."""
        physics = sapien.physx.PhysxCpuSystem()
        physics.timestep = self._timestep
        scene = sapien.Scene([physics])
        for entity in self._entities:
            entity.remove_from_scene()
        for entity in self._entities:
            scene.add_entity(entity)
        self._env.scene.px, self._env.scene.sub_scenes[0] = physics, scene
        positions, velocities, targets = self._state["joints"]
        self._robot.set_qpos(positions)
        self._robot.set_qvel(velocities)
        for joint, target in zip(self._robot.active_joints, targets, strict=True):
            joint.set_drive_target(float(target))
        for body, row in zip(self._bodies, self._state["objects"], strict=True):
            _write(body, row)


def _read(body: Any) -> NDArray[np.float32]:
    pose = body.entity.pose
    return np.concatenate([pose.p, pose.q, body.linear_velocity, body.angular_velocity])


def _write(body: Any, row: NDArray[np.float32]) -> None:
    body.entity.set_pose(sapien.Pose(row[:3], row[3:7]))
    if not body.kinematic:  # goals are moved by hand and have no velocity
        body.set_linear_velocity(row[7:10])
        body.set_angular_velocity(row[10:])
