"""Draws ManiSkill's scenes: a MuJoCo scene of the same bodies takes over their poses."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.simulators.maniskill_env import TASKS
from workers.simulators.maniskill_scene import LINKS, build_model
from workers.simulators.mujoco_renderer import SceneRenderer, mujoco
from workers.simulators.robot_observation import PICTURE_SIZE


class Drawing:
    """The drawn scene of one environment."""

    def __init__(self, env: Any, task: str) -> None:
        self._model = build_model(env, task)
        self._data = mujoco.MjData(self._model)
        names = (*LINKS, *TASKS[task].objects)
        self._places = {name: int(self._model.body_mocapid[self._model.body(name).id]) for name in names}
        self._renderer = SceneRenderer(self._model, PICTURE_SIZE, (), {})
        self.close = self._renderer.close

    def follow(self, entities: Mapping[str, Any]) -> None:
        """Puts every drawn body where the entity of its name is."""
        for name, place in self._places.items():
            pose = entities[name].pose
            self._data.mocap_pos[place], self._data.mocap_quat[place] = pose.p, pose.q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)

    def draw(self, camera: str, size: int) -> NDArray[np.uint8]:
        """A new picture (size, size, 3) RGB from `front` or `wrist`."""
        return self._renderer.draw(self._data, camera, size)
