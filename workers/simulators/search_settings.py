"""What a search for the action behind a step needs to know of a simulator whose actions are boxes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

JOINT, JOINT_SPEED, FINGER = 0.01, 0.1, 0.005  # rad, rad/s, m: what counts as 1 in `motion`
HAND = 4  # numbers of `motion`, the last ones
STREAM = "proprioception"


@dataclass(frozen=True)
class SearchSettings:
    """continuous: the first so many numbers of an action act gradually, and a search follows its slopes in them.
    grips: values of the action's last number, the gripper's, that a search begins with; where that number is not
        continuous they are all that can be told apart.
    stream: of the observation, to verify an action by: what it moves itself, not what that pushes.
    tolerance: the largest difference in any number of the stream (m, or entries of a rotation matrix) at which an
        action counts as found.
    """

    continuous: int
    grips: tuple[float, ...]
    stream: str = STREAM
    tolerance: float = 1e-4


def motion(
    positions: NDArray[Any], velocities: NDArray[Any], fingers: NDArray[Any], sent: NDArray[Any]
) -> NDArray[np.float64]:
    """What a robot does, (2 joints + HAND,): positions (rad) and velocities (rad/s) of its joints, where its two
    fingers are and where they are sent (m), each in units in which 1 is much.

    The velocities tell actions apart that lead to one pose; where fingers are sent, those that press on one object.
    """
    scaled = [positions / JOINT, velocities / JOINT_SPEED, fingers / FINGER, sent / FINGER]
    return np.concatenate(scaled, dtype=np.float64)
