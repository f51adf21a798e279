"""A picture for people: an episode of every task, its frames from both cameras beside each other."""

from contextlib import closing
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.simulators.speed import TASKS, Task
from workers.simulators.base import Observation
from workers.simulators.catalog import make_behavior, make_simulator

FRAMES = 6
CAMERAS = ("front", "wrist")
INCHES, DOTS = 1.3, 120  # of a frame; dots an inch


def draw(behavior: str, path: Path, seed: int = 0) -> None:
    """Two rows a task, the front camera's above the wrist's; from left to right FRAMES frames of the episode."""
    figure = Figure(figsize=(FRAMES * INCHES + 1.2, 2 * len(TASKS) * INCHES), dpi=DOTS)
    axes = figure.subplots(2 * len(TASKS), FRAMES)
    for row, task in enumerate(TASKS):
        seen = _episode(task, behavior, seed)
        for column, number in enumerate(np.linspace(0, len(seen) - 1, FRAMES).astype(int)):
            for line, camera in enumerate(CAMERAS):
                place = axes[2 * row + line, column]
                _show(place, seen[number][camera])
                if line == 0:
                    place.set_title(f"step {number}", fontsize=7, pad=2)
            axes[2 * row, 0].set_ylabel(task.name, fontsize=8)
    figure.tight_layout(pad=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _show(place: Axes, image: NDArray[np.uint8]) -> None:
    place.imshow(image)
    place.set_xticks([])
    place.set_yticks([])


def _episode(task: Task, behavior: str, seed: int) -> list[Observation]:
    with closing(make_simulator(task.simulator, {"task": task.name})) as simulator:
        acting, rng = make_behavior(behavior, simulator), np.random.default_rng(seed)
        seen = [simulator.reset(seed)]
        acting.reset(rng)
        while True:
            step = simulator.step(acting.act(simulator, rng))
            seen.append(step.observation)
            if step.terminated or step.truncated:
                return seen
