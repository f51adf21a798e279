"""Imports the robot simulators' packages, quietly: the one place that sets what they read when they are imported.

Pictures are drawn by MuJoCo in software (`MUJOCO_GL=osmesa`) unless the process was started with another value:
`MUJOCO_GL=egl` draws on a GPU, `MUJOCO_EGL_DEVICE_ID` says on which. Pictures of the two differ in single grey levels.
"""

import logging
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import version
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from workers.simulators.base import SimulatorUnavailable, StateError

LOGGERS = ("robosuite_logs", "mani_skill ")  # the space is in ManiSkill's name
WARNINGS: dict[str, type[Warning]] = {
    "Failed to find system libvulkan": UserWarning,  # no picture of ours needs it
    "The 'warn' method is deprecated": DeprecationWarning,  # ManiSkill's, while it builds a scene
}
COMMAND = "make setup-robots"


def load(name: str) -> ModuleType:
    """The named module of a robot simulator. Raises SimulatorUnavailable with the command that installs it."""
    os.environ.setdefault("MUJOCO_GL", "osmesa")  # robosuite would set egl, which needs a device
    for logger in LOGGERS:
        logging.getLogger(logger).addFilter(_is_error)
    try:
        with quiet():
            return import_module(name)
    # PyOpenGL meets a missing libOSMesa as an AttributeError, MuJoCo an unknown MUJOCO_GL as a RuntimeError.
    except (ImportError, OSError, AttributeError, RuntimeError) as error:
        raise SimulatorUnavailable(
            f"Package {name.partition('.')[0]!r} cannot be imported ({error}). Run `{COMMAND}` in the environment of "
            "this process: it installs the robot simulators and the libraries that they draw with."
        ) from error


@contextmanager
def quiet() -> Iterator[None]:
    """Without the warnings that the packages are known to give; nobody here can act on them."""
    with warnings.catch_warnings():
        for message, category in WARNINGS.items():
            warnings.filterwarnings("ignore", message, category)
        yield


def versions(*names: str) -> NDArray[np.int64]:
    """The installed versions of packages, three numbers each, as a state carries them: (3 * len(names),)."""
    return np.array([int(number) for name in names for number in re.findall(r"\d+", version(name))[:3]], np.int64)


def check_version(
    found: NDArray[np.int64], expected: NDArray[np.int64], tasks: Sequence[str], names: Sequence[str]
) -> None:
    """Both: number of the task, then three numbers of each named package. Raises StateError where they differ."""
    if not np.array_equal(found, expected):
        told, own = (_told(version.tolist(), tasks, names) for version in (found, expected))
        raise StateError(f"State 'version' is of {told}, but this is {own}.")


def _told(version: list[int], tasks: Sequence[str], names: Sequence[str]) -> str:
    number, *numbers = version
    task = tasks[number] if 0 <= number < len(tasks) else f"number {number}"
    dotted = (".".join(map(str, numbers[start : start + 3])) for start in range(0, len(numbers), 3))
    return f"task {task} in {' with '.join(f'{name} {release}' for name, release in zip(names, dotted, strict=True))}"


def _is_error(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.ERROR
