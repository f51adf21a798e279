"""Scripted experts of the ManiSkill tasks. They read the poses of the objects, never the images.

The gripper at rest points down, `DOWN`, with fingers that close along y.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from workers.simulators.base import Simulator
from workers.simulators.robot_observation import Pose
from workers.simulators.rotations import Matrix, Vector, rotation
from workers.simulators.waypoints import CLOSED, OPEN, Course, Drive, Waypoint

DOWN: Matrix = np.diag([1.0, -1, -1])
AHEAD: Matrix = rotation(np.array([0, -np.pi / 2, 0])) @ DOWN  # the hand level, pointing along x
DRIVE = Drive(reach=0.1, turn=-0.1, open=1, closed=-1, gain=1.5)


def plan(simulator: Simulator) -> tuple[Course, Callable[[], Pose]]:
    """The course of a ManiSkill simulator's task."""
    robot: Any = simulator  # a ManiSkillSimulator; naming it here would be a circle of imports
    return Course(_PLANS[robot.options.task](robot), DRIVE), robot.view.grip


def _down() -> Matrix:
    return DOWN


def _pull(robot: Any) -> list[Waypoint]:
    cube, goal = robot.view.body("obj")[0], robot.view.body("goal_region")[0]
    behind, end = cube[0] + 0.06, goal[0] + 0.06
    return [
        Waypoint(_fixed(behind, cube[1], 0.12), _down, CLOSED, aligned=0.1, most=20),
        Waypoint(_fixed(behind, cube[1], 0.025), _down, CLOSED, near=0.01, aligned=0.1, most=20),
        Waypoint(_fixed(end, cube[1], 0.025), _down, CLOSED, near=0.01, aligned=0.1, most=20),
    ]


def _poke(robot: Any) -> list[Waypoint]:
    cube, peg, goal = (robot.view.body(name)[0] for name in ("cube", "peg", "goal_region"))
    x = peg[0] - 0.07  # where the peg is held: far enough back that the cube's goal is within reach
    ahead = robot.env.peg_half_length + 0.02 - (x - peg[0])  # from the grip point to the middle of a touched cube
    return [
        Waypoint(_fixed(x, peg[1], 0.14), _down, OPEN, aligned=0.1, most=20),
        Waypoint(_fixed(x, peg[1], 0.025), _down, OPEN, near=0.008, aligned=0.1, most=20),
        Waypoint(_fixed(x, peg[1], 0.025), _down, CLOSED, near=0.01, aligned=0.1, least=4, most=20),
        Waypoint(_fixed(x, cube[1], 0.028), _down, CLOSED, near=0.008, aligned=0.1, most=20),
        Waypoint(_fixed(cube[0] - ahead - 0.02, cube[1], 0.028), _down, CLOSED, near=0.015, aligned=0.1, most=20),
        Waypoint(
            _fixed(goal[0] - ahead - 0.01, cube[1], 0.028), _down, CLOSED, 0.005, 0.1, least=5, most=40, speed=0.3
        ),
    ]


def _lift_peg(robot: Any) -> list[Waypoint]:
    view, half = robot.view, robot.env.peg_half_length
    peg = view.body("peg")[0]
    x = min(peg[0] + 0.09, 0.14)  # near the end, but no farther than a hand that points down can reach
    end, y = 0.22, 0.3 * peg[1]

    def upright() -> Matrix:
        """The hand turned by what the peg still lacks: its held end up."""
        axis = view.body("peg")[1][:, 0]
        cross = np.cross(axis, [0, 0, 1])
        sine = float(np.linalg.norm(cross))
        return np.asarray(rotation(cross / max(sine, 1e-9) * np.arctan2(sine, axis[2])) @ view.grip()[1])

    def standing() -> Vector:
        """Where the hand is when the peg's lower end is a millimetre above the table."""
        held = view.grip()[0][2] - view.body("peg")[0][2]
        return np.array([end, y, held + half + 0.001])

    return [
        Waypoint(_fixed(x, peg[1], 0.12), _down, OPEN, aligned=0.1, most=20),
        Waypoint(_fixed(x, peg[1], 0.022), _down, OPEN, near=0.008, aligned=0.1, most=20),
        Waypoint(_fixed(x, peg[1], 0.022), _down, CLOSED, near=0.01, aligned=0.1, least=4, most=20),
        Waypoint(_fixed(end, y, 0.27), upright, CLOSED, near=0.03, aligned=0.04, most=45),
        Waypoint(standing, upright, CLOSED, near=0.004, aligned=0.08, most=20, speed=0.5),
        Waypoint(standing, None, OPEN, near=0.01, least=3, most=20),
        Waypoint(_fixed(end - 0.1, y, 0.3), None, OPEN, near=0.01, least=3, most=20),
    ]


def _fixed(x: float, y: float, z: float) -> Callable[[], Vector]:
    place = np.array([x, y, z])
    return lambda: place


_PLANS: dict[str, Callable[[Any], list[Waypoint]]] = {
    "PullCube": _pull,
    "PokeCube": _poke,
    "LiftPegUpright": _lift_peg,
}
