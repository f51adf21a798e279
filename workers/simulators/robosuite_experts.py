"""Scripted experts of the robosuite tasks. They read the poses of the bodies, never the images.

The gripper's own rotation matrix at rest, `DOWN`, points it down with fingers that close along y.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from workers.simulators.base import Simulator
from workers.simulators.robot_observation import Pose
from workers.simulators.rotations import Matrix, Vector, about_z, wrapped, yaw
from workers.simulators.waypoints import CLOSED, OPEN, Course, Drive, Waypoint

DOWN: Matrix = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
DRIVE = Drive(reach=0.05, turn=0.5, open=-1, closed=1, gain=2.0, drift=0.06)
BIN_SHIFT = np.array([-0.04, -0.06, 0])  # robosuite names a corner of the can's compartment
CARRY, SQUARE_CARRY = 0.30, 1.01  # m: above the bin, in the world


def plan(simulator: Simulator) -> tuple[Course, Callable[[], Pose]]:
    """The course of a robosuite simulator's task."""
    robot: Any = simulator  # a RobosuiteSimulator; naming it here would be a circle of imports
    waypoints = _PLANS[robot.options.task](robot)
    return Course(waypoints, DRIVE), robot.view.grip


def _lift(robot: Any) -> list[Waypoint]:
    place, cube = robot.view.body("cube_main")

    def turned() -> Matrix:
        return about_z(wrapped(yaw(cube), np.pi / 2)) @ DOWN

    return [
        Waypoint(_above(place, 0.10), turned, OPEN),
        Waypoint(_above(place, 0), turned, OPEN, near=0.01, aligned=0.1, most=40),
        Waypoint(_above(place, 0), turned, CLOSED, aligned=0.3, least=5, most=10),
        Waypoint(_above(place, 0.15), turned, CLOSED, aligned=0.3),
    ]


def _can(robot: Any) -> list[Waypoint]:
    place, _ = robot.view.body("Can_main")
    target = robot.env.target_bin_placements[robot.env.object_id] + BIN_SHIFT
    table = robot.env.bin2_pos[2]
    high = table + CARRY

    def down() -> Matrix:
        return DOWN

    return [
        Waypoint(_above(place, 0.12), down, OPEN),
        Waypoint(_above(place, 0.01), down, OPEN, near=0.01, aligned=0.1, most=40),
        Waypoint(_above(place, 0.01), down, CLOSED, aligned=0.3, least=6, most=10),
        Waypoint(_at(place, high), down, CLOSED, near=0.04, aligned=0.3),
        Waypoint(_at(target, high), down, CLOSED, near=0.03, aligned=0.3, most=80),
        Waypoint(_at(target, table + 0.10), down, CLOSED, near=0.03, aligned=0.3),
        Waypoint(_at(target, table + 0.12), down, OPEN, near=0.03, aligned=0.3, least=4, most=10),
        Waypoint(_at(target, high), down, OPEN, near=0.03, aligned=0.3),
    ]


def _square(robot: Any) -> list[Waypoint]:
    view = robot.view
    peg = view.body("peg1")[0]
    nut = yaw(view.body("SquareNut_main")[1])
    grasp = wrapped(nut, np.pi)
    goal = nut + _nut_turn(nut, grasp)
    held: list[Vector] = []

    def handle() -> Vector:
        return np.asarray(view.site("SquareNut_handle_site"))

    def grasped() -> Vector:
        if not held:
            held.append(view.grip()[0])
        return held[0]

    def turned() -> Matrix:
        return about_z(grasp) @ DOWN

    def square_on() -> Matrix:
        """The hand vertical, and turned by what the nut still lacks."""
        lacking = wrapped(goal - yaw(view.body("SquareNut_main")[1]), 2 * np.pi)
        return about_z(yaw(view.grip()[1] @ DOWN.T) + lacking) @ DOWN

    def over(height: float) -> Callable[[], Vector]:
        def where() -> Vector:
            shift = peg - view.body("SquareNut_main")[0]
            return np.array([*(view.grip()[0] + shift)[:2], height])

        return where

    return [
        Waypoint(lambda: handle() + _up(0.10), turned, OPEN, aligned=0.1, most=80),
        Waypoint(handle, turned, OPEN, near=0.008, aligned=0.06, most=50),
        Waypoint(grasped, turned, CLOSED, aligned=0.3, least=8, most=12),
        Waypoint(lambda: np.array([*grasped()[:2], SQUARE_CARRY]), turned, CLOSED, near=0.03, aligned=0.3),
        Waypoint(over(SQUARE_CARRY), square_on, CLOSED, near=0.008, aligned=0.04, most=150, settled=4),
        Waypoint(over(peg[2] + 0.12), square_on, CLOSED, near=0.006, aligned=0.03, speed=0.3, settled=2),
        Waypoint(over(peg[2] + 0.01), square_on, CLOSED, near=0.012, aligned=0.1, speed=0.5),
        Waypoint(lambda: view.grip()[0], None, OPEN, least=4, most=10),
        Waypoint(lambda: view.grip()[0] + _up(0.1), None, OPEN, near=0.01, least=6, most=30),
    ]


def _nut_turn(nut: float, grasp: float) -> float:
    """How far to turn the nut so that it fits the peg: little, and its handle towards the robot, within reach."""
    turns = [wrapped(grasp - wrapped(nut, np.pi / 2) + quarter * np.pi / 2, 2 * np.pi) for quarter in range(4)]

    def cost(turn: float) -> float:
        is_away = float(np.cos(nut + turn - grasp)) > 0.5
        return 3.0 * is_away + abs(turn) + 0.2 * abs(turn - grasp)

    return min(turns, key=cost) - grasp


def _above(place: Vector, height: float) -> Callable[[], Vector]:
    return lambda: place + _up(height)


def _at(place: Vector, height: float) -> Callable[[], Vector]:
    return lambda: np.array([place[0], place[1], height])


def _up(height: float) -> Vector:
    return np.array([0, 0, height])


_PLANS: dict[str, Callable[[Any], list[Waypoint]]] = {
    "Lift": _lift,
    "PickPlaceCan": _can,
    "NutAssemblySquare": _square,
}
