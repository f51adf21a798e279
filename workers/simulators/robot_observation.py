"""What a robot arm observes and how it acts, the same for every task of every robot simulator.

Streams with cameras: `front` and `wrist`, (64, 64, 3) uint8 RGB, and `proprioception`. The poses of the objects are not
among them: a camera has to find them, as on a real robot. Without cameras: `proprioception` and `objects`, the whole
arrangement in numbers, for models and policies that are to be trained in minutes.

`proprioception`, (11,) float32: position of the grip point (x, y, z; m, world frame), the first two columns of its
rotation matrix (6), distance of each finger from the middle (2; m). Rotation matrices and not quaternions: they have
one value for a rotation and no jumps, and a gripper that points down is right where quaternions jump from q to -q.
`objects`, (9 n,) float32: of each object the position and the two columns likewise.
"""

from collections.abc import Iterable

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from workers.simulators.base import Action, SimulatorError

IMAGE_SIZE = 64
PICTURE_SIZE = 256  # of the pictures for people
CAMERAS = ("front", "wrist")
POSE = 9
PROPRIOCEPTION = POSE + 2
ACTION_SPACE = gym.spaces.Box(-1, 1, (7,), np.float32)

Pose = tuple[NDArray[np.float64], NDArray[np.float64]]
"""A position (3,) in metres and a rotation matrix (3, 3), in the world frame."""


def observation_space(cameras: bool, objects: int) -> gym.spaces.Dict:
    """The streams above; `objects` counts the task's objects."""
    if cameras:
        image = {name: gym.spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8) for name in CAMERAS}
        return gym.spaces.Dict({**image, "proprioception": _vector(PROPRIOCEPTION)})
    return gym.spaces.Dict({"proprioception": _vector(PROPRIOCEPTION), "objects": _vector(POSE * objects)})


def proprioception(grip: Pose, fingers: NDArray[np.float64]) -> NDArray[np.float32]:
    """fingers: the two joint positions, (2,) in metres, whichever sign the simulator gives them."""
    numbers: NDArray[np.float64] = np.concatenate([*_numbers(grip), np.abs(fingers)])
    return numbers.astype(np.float32)


def objects(poses: Iterable[Pose]) -> NDArray[np.float32]:
    """The stream `objects`."""
    return np.concatenate([part for pose in poses for part in _numbers(pose)]).astype(np.float32)


def checked_action(action: Action) -> NDArray[np.float32]:
    """The action as the simulator takes it. Raises SimulatorError for one outside the action space."""
    array = np.asarray(action, np.float32)
    if not ACTION_SPACE.contains(array):
        raise SimulatorError(f"Action must be 7 numbers from -1 to 1, but it is {np.asarray(action).tolist()}.")
    return array


def _vector(size: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def _numbers(pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    position, rotation = pose
    return position, rotation[:, :2].T.ravel()
