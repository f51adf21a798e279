"""Frames and filmstrips of image trajectories, as PNG files."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from api_schemas.environments import is_picture
from api_schemas.projects import Project
from asim.client import Client
from asim.errors import AsimError

FRAMES = 8  # of a filmstrip
SMALLEST, GAP, TITLE = 128, 4, 14  # pixels: of a frame's shorter side, between frames, above them
Frames = NDArray[np.uint8]


def pictures_of(client: Client, project: Project, trajectory: str) -> dict[str, Frames]:
    """The frames of each camera, (T + 1, H, W, 3). Raises AsimError where the project has no camera."""
    streams = project.environment.resolved_spaces().observations
    cameras = [name for name, stream in sorted(streams.items()) if is_picture(stream)]
    if not cameras:
        raise AsimError(f"project {project.name} has no camera: its streams are {', '.join(sorted(streams))}")
    content = client.trajectory_content(project.id, trajectory)
    return {name: content[name].astype(np.uint8, copy=False) for name in cameras}


def write_frames(pictures: Mapping[str, Frames], folder: Path) -> int:
    """`folder/CAMERA/0000.png` and so on, pixel for pixel; how many."""
    for camera, frames in pictures.items():
        (folder / camera).mkdir(parents=True, exist_ok=True)
        for step, frame in enumerate(frames):
            Image.fromarray(frame).save(folder / camera / f"{step:04}.png")
    return sum(map(len, pictures.values()))


def write_filmstrip(pictures: Mapping[str, Frames], folder: Path) -> Path:
    """`folder/filmstrip.png`: a row for each camera, FRAMES of its frames from the first to the last."""
    folder.mkdir(parents=True, exist_ok=True)
    filmstrip(pictures).save(folder / "filmstrip.png")
    return folder / "filmstrip.png"


def filmstrip(pictures: Mapping[str, Frames]) -> Image.Image:
    """The picture; small frames are enlarged, each pixel to a square."""
    steps = chosen_steps(len(next(iter(pictures.values()))))
    rows = [_row(camera, frames, steps) for camera, frames in pictures.items()]
    strip = Image.new("RGB", (max(row.width for row in rows), sum(row.height for row in rows)), "white")
    top = 0
    for row in rows:
        strip.paste(row, (0, top))
        top += row.height
    return strip


def chosen_steps(observations: int) -> list[int]:
    """FRAMES of them, as far from each other as can be; all where there are fewer."""
    return [int(step) for step in np.linspace(0, observations - 1, min(FRAMES, observations)).round()]


def _row(camera: str, frames: Frames, steps: list[int]) -> Image.Image:
    height, width = frames.shape[1:3]
    scale = -(-SMALLEST // min(height, width))  # rounded up
    row = Image.new("RGB", (len(steps) * (width * scale + GAP), TITLE + height * scale + GAP), "white")
    for place, step in enumerate(steps):
        left, frame = place * (width * scale + GAP), Image.fromarray(frames[step])
        row.paste(frame.resize((width * scale, height * scale), Image.Resampling.NEAREST), (left, TITLE))
        ImageDraw.Draw(row).text((left, 1), f"{camera} {step}", fill="black")
    return row
