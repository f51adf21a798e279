"""Scripted experts: a hand that goes from waypoint to waypoint, for any robot arm."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from workers.simulators.base import Simulator
from workers.simulators.robot_observation import Pose
from workers.simulators.rotations import Matrix, Vector, rotation_vector

OPEN, CLOSED = False, True


@dataclass(frozen=True)
class Waypoint:
    """Where the hand is to be, how it is to be turned, and its fingers; where and how may follow what happens.

    It is reached when the hand was within `near` (m) and `aligned` (rad) for `settled` steps in a row and after more
    than `least` steps, and given up for the next one after `most`. `speed` limits the action's first three numbers.
    """

    position: Callable[[], Vector]
    rotation: Callable[[], Matrix] | None
    closed: bool
    near: float = 0.02
    aligned: float = 0.15
    least: int = 0
    most: int = 60
    speed: float = 1.0
    settled: int = 1


@dataclass(frozen=True)
class Drive:
    """How a simulator's actions move its hand: `reach` (m) and `turn` (rad) of an action of 1, the sign included, the
    numbers that open and close the gripper, and the gains of the errors, `drift` for their sum over time."""

    reach: float
    turn: float
    open: float
    closed: float
    gain: float
    drift: float = 0.0


class Course:
    """One episode's waypoints, and how far along the hand is."""

    def __init__(self, waypoints: Sequence[Waypoint], drive: Drive) -> None:
        self._waypoints, self._drive = waypoints, drive
        self._at, self._steps, self._good = 0, 0, 0
        self._sum = np.zeros(3)

    def act(self, hand: Pose) -> NDArray[np.float32]:
        """The action (7,) that brings the hand, now at a pose, nearer."""
        waypoint, distance, turn = self._errors(hand)
        self._steps += 1
        is_good = np.linalg.norm(distance) < waypoint.near and np.linalg.norm(turn) < waypoint.aligned
        self._good = self._good + 1 if is_good else 0
        is_done = self._good >= waypoint.settled and self._steps > waypoint.least
        if (is_done or self._steps > waypoint.most) and self._at + 1 < len(self._waypoints):
            self._at, self._steps, self._good, self._sum = self._at + 1, 0, 0, np.zeros(3)
            return self.act(hand)
        return self._action(waypoint, distance, turn)

    def _errors(self, hand: Pose) -> tuple[Waypoint, Vector, Vector]:
        position, rotation = hand
        waypoint = self._waypoints[self._at]
        turn = rotation_vector(waypoint.rotation() @ rotation.T) if waypoint.rotation else np.zeros(3)
        return waypoint, waypoint.position() - position, turn

    def _action(self, waypoint: Waypoint, distance: Vector, turn: Vector) -> NDArray[np.float32]:
        drive = self._drive
        small = np.abs(distance) < 0.02  # the sum is for the last millimetres
        self._sum = np.clip(self._sum + drive.drift * distance * small, -0.02, 0.02)
        move = (drive.gain * distance + self._sum) / drive.reach
        spin = drive.gain * turn / drive.turn
        move /= max(1.0, np.abs(move).max() / waypoint.speed)
        spin /= max(1.0, float(np.linalg.norm(spin)))
        gripper = drive.closed if waypoint.closed else drive.open
        return np.clip([*move, *spin, gripper], -1, 1).astype(np.float32)


class Planner(Protocol):
    """Plans an episode from its first state."""

    def __call__(self, simulator: Simulator) -> tuple[Course, Callable[[], Pose]]:
        """The course, and where the hand is."""


class ExpertBehavior:
    """Follows the course that its planner lays at the first step of an episode."""

    def __init__(self, plan: Planner) -> None:
        self._plan = plan
        self._laid: tuple[Course, Callable[[], Pose]] | None = None

    def reset(self, rng: np.random.Generator) -> None:
        """A new course is laid at the next step."""
        del rng
        self._laid = None

    def act(self, simulator: Simulator, rng: np.random.Generator) -> NDArray[np.float32]:
        """The next action."""
        del rng
        if self._laid is None:
            self._laid = self._plan(simulator)
        course, hand = self._laid
        return course.act(hand())
