"""What is seen of a robosuite simulation: poses and pictures, computed from positions alone in a copy of it.

robosuite's own poses are those of the last substep but one after a step, and fresh after a restore; a copy is always
fresh, and looking leaves the simulation as it is.
"""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.simulators.mujoco_renderer import SceneRenderer
from workers.simulators.robot_observation import CAMERAS, IMAGE_SIZE, PICTURE_SIZE, Pose
from workers.simulators.robot_packages import load

mujoco: Any = load("mujoco")

NAMES = {"front": "agentview", "wrist": "robot0_eye_in_hand"}  # robosuite's cameras
UNSEEN = {"robot0_eye_in_hand": ("robot0_",)}  # the arm is behind the camera at its wrist
NEVER = ("fixed_mount0_",)  # the pedestal: costs a tenth of the triangles and shows nothing
GRIP = "gripper0_right_grip_site"
FINGERS = ("gripper0_right_finger_joint1", "gripper0_right_finger_joint2")


class View:
    """A second MjData of an environment's model. `update` follows the simulation."""

    def __init__(self, env: Any) -> None:
        self._model, self._source = env.sim.model._model, env.sim.data._data
        self._data = mujoco.MjData(self._model)

    def update(self) -> None:
        """Takes over the positions; kinematics and cameras follow."""
        self._data.qpos[:] = self._source.qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)

    def grip(self) -> Pose:
        """The grip point between the fingers."""
        site = self._data.site(GRIP)
        return site.xpos.copy(), site.xmat.reshape(3, 3).copy()

    def body(self, name: str) -> Pose:
        """One of MuJoCo's bodies."""
        body = self._data.body(name)
        return body.xpos.copy(), body.xmat.reshape(3, 3).copy()

    def site(self, name: str) -> NDArray[np.float64]:
        """The position (3,) of one of MuJoCo's sites."""
        return np.array(self._data.site(name).xpos)

    def fingers(self) -> NDArray[np.float64]:
        """Positions of the two finger joints, (2,), m."""
        return np.array([self._data.joint(name).qpos[0] for name in FINGERS])

    def images(self) -> dict[str, NDArray[np.uint8]]:
        """`front` and `wrist`, (64, 64, 3)."""
        return {name: self._renderer.draw(self._data, NAMES[name], IMAGE_SIZE) for name in CAMERAS}

    def picture(self) -> NDArray[np.uint8]:
        """What the front camera sees, (256, 256, 3)."""
        return self._renderer.draw(self._data, NAMES["front"], PICTURE_SIZE)

    def close(self) -> None:
        """Frees the renderer; the next picture makes a new one."""
        if "_renderer" in vars(self):
            vars(self).pop("_renderer").close()

    @cached_property
    def _renderer(self) -> SceneRenderer:
        return SceneRenderer(self._model, PICTURE_SIZE, NEVER, UNSEEN)
