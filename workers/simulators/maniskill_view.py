"""What is seen of a ManiSkill simulation: poses, and pictures that MuJoCo draws, so that no Vulkan device is needed.

The drawn scene is the same on every machine, and drawn twenty times as fast as by SAPIEN's own renderer in software.
"""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.simulators.maniskill_env import TASKS
from workers.simulators.robot_observation import CAMERAS, IMAGE_SIZE, PICTURE_SIZE, Pose

GRIP = "panda_hand_tcp"
FINGERS = slice(-2, None)


class View:
    """Reads an environment's links and objects, by name."""

    def __init__(self, env: Any, task: str) -> None:
        self._env, self._task = env, task
        self._robot = env.agent.robot._objs[0]
        self._entities = {link.entity.name: link.entity for link in self._robot.links}
        self._entities |= {name: getattr(env, name)._objs[0] for name in TASKS[task].objects}

    def grip(self) -> Pose:
        """The grip point between the fingers."""
        return self.body(GRIP)

    def body(self, name: str) -> Pose:
        """A link of the robot or an object of the task."""
        matrix = self._entities[name].pose.to_transformation_matrix().astype(np.float64)
        return matrix[:3, 3], matrix[:3, :3]

    def fingers(self) -> NDArray[np.float64]:
        """Positions of the two finger joints, (2,), m."""
        return np.asarray(self._robot.qpos[FINGERS], np.float64)

    def images(self) -> dict[str, NDArray[np.uint8]]:
        """`front` and `wrist`, (64, 64, 3)."""
        self._drawing.follow(self._entities)
        return {name: self._drawing.draw(name, IMAGE_SIZE) for name in CAMERAS}

    def picture(self) -> NDArray[np.uint8]:
        """What the front camera sees, (256, 256, 3)."""
        self._drawing.follow(self._entities)
        picture: NDArray[np.uint8] = self._drawing.draw("front", PICTURE_SIZE)
        return picture

    def close(self) -> None:
        """Frees the renderer; the next picture makes a new one."""
        if "_drawing" in vars(self):
            vars(self).pop("_drawing").close()

    @cached_property
    def _drawing(self) -> Any:
        from workers.simulators.maniskill_drawing import Drawing  # needs MuJoCo, which is loaded for pictures only

        return Drawing(self._env, self._task)
