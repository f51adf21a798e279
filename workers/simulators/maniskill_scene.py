"""The MuJoCo model that ManiSkill's scenes are drawn with: its Panda, its table and its objects, without physics."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.simulators.robot_packages import load

mujoco: Any = load("mujoco")

MESHES = "assets/robots/panda/franka_description/meshes/collision"
LINKS = {f"panda_link{number}": f"link{number}" for number in range(8)} | {
    "panda_hand": "hand",
    "panda_leftfinger": "finger",
    "panda_rightfinger": "finger",
}
HALF_TURN = (0.0, 0.0, 0.0, 1.0)  # about z: the two fingers are one mesh
BLUE, RED, DARK_RED, WHITE = (0.05, 0.16, 0.63, 1), (1, 0, 0, 1), (0.69, 0.05, 0.05, 1), (1, 1, 1, 1)
LIGHT_GREY, GREY, DARK_GREY = (0.9, 0.9, 0.92, 1), (0.72, 0.72, 0.76, 1), (0.25, 0.25, 0.27, 1)
FRONT = {  # the front camera's place and what it looks at, m: as near as the task's space allows
    "PullCube": ((0.45, 0.0, 0.5), (-0.1, 0.0, 0.04)),
    "PokeCube": ((0.8, 0.0, 0.6), (0.07, 0.0, 0.02)),
    "LiftPegUpright": ((0.7, 0.0, 0.5), (0.05, 0.0, 0.07)),
}
FRONT_ANGLE = 45  # degrees
WRIST = ((0.08, 0.0, 0.0), (0.035, 0.0, 0.12))  # likewise of the camera at the hand, in the hand's frame: z is ahead
WRIST_ANGLE = 75
FLOOR, WALLS = 0.9, 2.5  # m: below the table's top, and before and behind it
RINGS = 5


def build_model(env: Any, task: str) -> Any:
    """An MjModel of mocap bodies that are named like the robot's links and the task's objects."""
    spec = mujoco.MjSpec()
    spec.meshdir = str(Path(str(load("mani_skill").__file__)).parent / MESHES)
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.45] * 3, [0.5] * 3
    spec.stat.extent, spec.visual.map.znear = 1, 0.01  # m: the wrist's camera comes near to the table
    _add_table(spec)
    for mesh in sorted(set(LINKS.values())):
        spec.add_mesh(name=mesh, file=f"{mesh}.stl")
    for number, (link, mesh) in enumerate(LINKS.items()):
        colour = DARK_GREY if mesh == "finger" else (LIGHT_GREY, GREY)[number % 2]
        turn = HALF_TURN if link == "panda_rightfinger" else (1.0, 0.0, 0.0, 0.0)
        body = spec.worldbody.add_body(name=link, mocap=True)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, quat=turn, rgba=colour, **_seen(link))
    _OBJECTS[task](spec, env)
    _add_cameras(spec, task)
    return spec.compile()


def _seen(name: str) -> dict[str, Any]:
    return {"name": name, "group": 1}


def _add_table(spec: Any) -> None:
    spec.add_texture(
        name="wood",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.62, 0.42, 0.25],
        rgb2=[0.58, 0.38, 0.22],
        width=64,
        height=64,
    )
    material = spec.add_material(name="wood", texrepeat=[12, 12])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "wood"
    table = {"size": [0.6, 1, 0.01], "pos": [0, 0, -0.01], "material": "wood"}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, **table, **_seen("table"))
    floor = {"size": [5, 5, 0.1], "pos": [0, 0, -FLOOR], "rgba": (0.45, 0.45, 0.48, 1)}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, **floor, **_seen("floor"))
    for name, place in (("back wall", -WALLS), ("front wall", WALLS)):  # else the sky is black
        wall = {"size": [0.05, 5, 3], "pos": [place, 0, 0], "rgba": (0.6, 0.63, 0.68, 1)}
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, **wall, **_seen(name))
    light = {"pos": [0, 0, 2], "dir": [0, 0, -1], "diffuse": [0.4] * 3}
    spec.worldbody.add_light(type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, **light)


def _add_cameras(spec: Any, task: str) -> None:
    eye, target = map(np.array, FRONT[task])
    turned = _quaternion(np.cross([0.0, 0.0, 1.0], eye - target), eye - target)
    spec.worldbody.add_camera(name="front", pos=eye, quat=turned, fovy=FRONT_ANGLE)
    eye, target = map(np.array, WRIST)
    turned = _quaternion(np.array([0.0, 1.0, 0.0]), eye - target)
    spec.body("panda_hand").add_camera(name="wrist", pos=eye, quat=turned, fovy=WRIST_ANGLE)


def _quaternion(right: NDArray[np.float64], back: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4,) of a camera, from the directions of its x and z axes, which are at right angles."""
    right, back = right / np.linalg.norm(right), back / np.linalg.norm(back)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.column_stack([right, np.cross(back, right), back]).ravel())
    return quaternion


def _add_cube(spec: Any, name: str, half_size: float, colour: Any) -> None:
    body = spec.worldbody.add_body(name=name, mocap=True)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[half_size] * 3, rgba=colour, **_seen(name))


def _add_peg(spec: Any, env: Any, tail: Any, head: Any) -> None:
    body = spec.worldbody.add_body(name="peg", mocap=True)
    half, width = env.peg_half_length / 2, env.peg_half_width
    for name, place, colour in (("tail", -half, tail), ("head", half, head)):
        size = [half, width, width]
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=[place, 0, 0], rgba=colour, **_seen(name))


def _add_target(spec: Any, radius: float) -> None:
    """Red and white rings; the axis is the x axis. Inner ones are a little thicker, so that they show."""
    body = spec.worldbody.add_body(name="goal_region", mocap=True)
    for ring in range(RINGS):
        size = [radius * (ring + 1) / RINGS, 0.0005 * (RINGS + 1 - ring), 0]
        colour, turn = (RED, WHITE)[ring % 2], [np.sqrt(0.5), 0, np.sqrt(0.5), 0]
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER
        body.add_geom(type=kind, size=size, quat=turn, rgba=colour, **_seen(f"ring{ring}"))


def _pull_cube(spec: Any, env: Any) -> None:
    _add_cube(spec, "obj", env.cube_half_size, BLUE)
    _add_target(spec, env.goal_radius)


def _poke_cube(spec: Any, env: Any) -> None:
    _add_cube(spec, "cube", env.cube_half_size, RED)
    _add_peg(spec, env, BLUE, BLUE)
    _add_target(spec, env.goal_radius)


def _lift_peg(spec: Any, env: Any) -> None:
    _add_peg(spec, env, DARK_RED, BLUE)


_OBJECTS = {"PullCube": _pull_cube, "PokeCube": _poke_cube, "LiftPegUpright": _lift_peg}
