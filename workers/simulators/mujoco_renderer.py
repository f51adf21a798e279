"""Draws a MuJoCo scene from its cameras, fast in software: no shadows, reflections or antialiasing."""

import atexit
import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.simulators.base import SimulatorUnavailable
from workers.simulators.robot_packages import COMMAND, load

mujoco: Any = load("mujoco")

SEEN, HIDDEN_FROM_SOME = 1, 3  # groups of geoms; the simulators' collision geoms are in group 0
MAX_GEOMS = 1000
OFF = ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_SKYBOX")


class SceneRenderer:
    """One OpenGL context for a model's life.

    MuJoCo's own Renderer frees its objects in whatever context is current, which spoils the pictures of every other
    one in the process; this one makes its own current before it draws and before it frees.

    model: an MjModel; its geoms are put into groups, which has no influence on the physics.
    size: of the largest picture, in pixels.
    never: prefixes of geoms that no camera needs. without: prefixes of geoms that a camera does not need, such as the
    arm for the camera at its wrist; they cost most of the time. Raises SimulatorUnavailable where nothing can be drawn.
    """

    def __init__(self, model: Any, size: int, never: tuple[str, ...], without: Mapping[str, tuple[str, ...]]) -> None:
        self._model, self._options = model, dict[str, Any]()
        prefixes = tuple(prefix for each in without.values() for prefix in each)
        _group(model, never, prefixes)
        self._without = without
        model.vis.quality.shadowsize = model.vis.quality.offsamples = 0  # the defaults cost 100 ms a picture
        model.vis.global_.offwidth = model.vis.global_.offheight = size
        try:
            self._window = mujoco.GLContext(size, size)
            self._window.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except (RuntimeError, mujoco.FatalError, load("OpenGL.error").Error) as error:
            raise SimulatorUnavailable(
                f"MuJoCo cannot draw here ({error}). Run `{COMMAND}`, or unset MUJOCO_GL to draw in software."
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        self._free = weakref.finalize(self, _free, self._window, self._context)
        atexit.register(self._free)  # before MuJoCo, at its own exit, ends what contexts live in

    def draw(self, data: Any, camera: str, size: int) -> NDArray[np.uint8]:
        """A new picture (size, size, 3) RGB. `data` is an MjData with current kinematics and cameras."""
        view = mujoco.MjvCamera()
        view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED.value, self._model.camera(camera).id
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option(camera), None, view, everything, self._scene)
        for flag in OFF:
            self._scene.flags[getattr(mujoco.mjtRndFlag, flag)] = 0
        self._window.make_current()
        rectangle, picture = mujoco.MjrRect(0, 0, size, size), np.empty((size, size, 3), np.uint8)
        mujoco.mjr_render(rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(picture, None, rectangle, self._context)
        return np.ascontiguousarray(picture[::-1])  # OpenGL begins below

    def close(self) -> None:
        """Frees the context; harmless when repeated."""
        self._free()
        atexit.unregister(self._free)

    def _option(self, camera: str) -> Any:
        if camera not in self._options:
            option = mujoco.MjvOption()
            option.geomgroup[:] = option.sitegroup[:] = 0
            option.geomgroup[SEEN] = 1
            option.geomgroup[HIDDEN_FROM_SOME] = camera not in self._without
            self._options[camera] = option
        return self._options[camera]


def _group(model: Any, never: tuple[str, ...], without: tuple[str, ...]) -> None:
    for number in range(model.ngeom):
        name = model.geom(number).name
        if model.geom_group[number] != SEEN:
            continue
        if never and name.startswith(never):
            model.geom_group[number] = 0
        elif without and name.startswith(without):
            model.geom_group[number] = HIDDEN_FROM_SOME


def _free(window: Any, context: Any) -> None:
    window.make_current()
    context.free()
    window.free()
