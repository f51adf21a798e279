"""Figures 10 and 11: what was seen, and what each arm's last world model predicts of it, frame by frame."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure as Picture
from numpy.typing import NDArray

from benchmarks.paper.robots.acquisition import SHOWN, ArmRun, examples
from benchmarks.paper.robots.errors import cameras_of
from benchmarks.paper.robots.loop import load

INCHES = 0.9  # a frame in the picture
Frames = NDArray[np.uint8]  # (steps, S, S, 3)


def draw(runs: Sequence[ArmRun], out: Path) -> list[Path]:
    """A picture for each camera and example of one comparison from one seed; none where nothing is seen."""
    finished = [run for run in runs if run.rollouts.exists()]
    if not finished:
        return []
    first, paths = finished[0], list[Path]()
    data = load(first.profile, first.task, first.data)
    shown, cameras = examples(data.tests), cameras_of(data.spaces)
    steps = [step for step in SHOWN if step <= shown.length]
    guesses = {run.arm.name: _read(run.rollouts) for run in finished}
    for camera in cameras:
        truth = shown.observations[camera][:, steps].numpy()  # (examples, steps, S, S, 3)
        for example, frames in enumerate(truth):
            rows = {"seen": frames, **{arm: guess[camera][example] for arm, guess in guesses.items()}}
            paths.append(out / f"10-{first.task.name}-{first.warm}-{first.seed}-{camera}-{example + 1}.png")
            draw_frames(rows, steps, paths[-1])
    return paths


def draw_frames(rows: Mapping[str, Frames], steps: Sequence[int], path: Path) -> None:
    """A row a name, a column a step."""
    size = (INCHES * len(steps) + 1.2, INCHES * len(rows) + 0.2)
    picture = Picture(figsize=size, dpi=120, layout="constrained")
    panels = picture.subplots(len(rows), len(steps), squeeze=False)
    for line, (name, frames) in enumerate(rows.items()):
        for column, step in enumerate(steps):
            axes = panels[line, column]
            axes.imshow(frames[column], interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            if line == 0:
                axes.set_title(str(step), fontsize=8)
        panels[line, 0].set_ylabel(name.replace(":", "\n"), fontsize=7, rotation=0, ha="right", va="center")
    picture.savefig(path)


def _read(path: Path) -> dict[str, Frames]:
    with np.load(path) as arrays:
        return {name: arrays[name] for name in arrays.files}
