"""asim export: frames come out pixel for pixel, filmstrips show the whole trajectory."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from asim.client import Client
from asim.filmstrip import GAP, SMALLEST, TITLE, chosen_steps
from tests.command import Command

SPACES = {
    "observations": {
        "front": {"dtype": "uint8", "shape": [64, 64, 3]},
        "wrist": {"dtype": "uint8", "shape": [32, 48, 3]},
        "code": {"dtype": "uint8", "shape": [6, 6, 3]},
        "proprioception": {"dtype": "float32", "shape": [9]},
    },
    "actions": {"kind": "box", "shape": [7]},
}
STEPS = 30


@pytest.fixture
def asim(url: str, command: Command, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Commands that ask the running service."""
    monkeypatch.setenv("ASIM_URL", url)
    return command


@pytest.fixture
def own(asim: Command, tmp_path: Path) -> str:
    """A project of two cameras, named after the test's folder."""
    (tmp_path / "spaces.json").write_text(json.dumps(SPACES))
    asim("project", "create", tmp_path.name, "--spaces", str(tmp_path / "spaces.json"))
    return tmp_path.name


def recorded(asim: Command, own: str, path: Path, seed: int) -> dict[str, NDArray[np.generic]]:
    """A trajectory that was imported."""
    rng, rows = np.random.default_rng(seed), STEPS + 1
    arrays: dict[str, NDArray[np.generic]] = {
        "front": rng.integers(0, 256, (rows, 64, 64, 3), np.uint8),
        "wrist": rng.integers(0, 256, (rows, 32, 48, 3), np.uint8),
        "code": rng.integers(0, 256, (rows, 6, 6, 3), np.uint8),
        "proprioception": rng.normal(size=(rows, 9)).astype(np.float32),
    }
    np.savez(path, **arrays)
    asim("import", own, str(path), "--split", "pool")
    return arrays


def test_frames_come_out_pixel_for_pixel_and_the_filmstrip_shows_eight_of_each_camera(
    asim: Command, own: str, url: str, tmp_path: Path
) -> None:
    arrays = recorded(asim, own, tmp_path / "one.npz", 1)
    with Client(url) as client:
        (trajectory,) = client.trajectories(client.find_project(own).id)
    said = asim("export", own, "--out", str(tmp_path / "out"))
    folder = tmp_path / "out" / trajectory.id[:12]
    assert said == f"{folder / 'filmstrip.png'}: front, wrist, {2 * (STEPS + 1)} frames beside it\n"
    assert sorted(path.name for path in folder.iterdir()) == ["filmstrip.png", "front", "wrist"]
    for camera in ("front", "wrist"):
        files = sorted((folder / camera).iterdir())
        assert [path.name for path in files] == [f"{step:04}.png" for step in range(STEPS + 1)]
        assert np.array_equal(np.stack([np.asarray(Image.open(path)) for path in files]), arrays[camera])
    strip = np.asarray(Image.open(folder / "filmstrip.png"))
    for place, step in enumerate(chosen_steps(STEPS + 1)):
        left = place * (SMALLEST + GAP)
        frame = strip[TITLE : TITLE + SMALLEST : 2, left : left + SMALLEST : 2]
        assert np.array_equal(frame, arrays["front"][step])
    second = strip[TITLE + SMALLEST + GAP + TITLE :][: 32 * 4 : 4, : 48 * 4 : 4]
    assert np.array_equal(second, arrays["wrist"][0])


def test_trajectories_are_chosen_by_id_or_by_number(asim: Command, own: str, url: str, tmp_path: Path) -> None:
    for seed in range(3):
        recorded(asim, own, tmp_path / f"{seed}.npz", seed)
    with Client(url) as client:
        ids = [each.id for each in client.trajectories(client.find_project(own).id)]
    out = str(tmp_path / "out")
    asim("export", own, ids[2], "--out", out, "--no-frames")
    assert [path.name for path in (tmp_path / "out").rglob("*")] == [ids[2][:12], "filmstrip.png"]
    asim("export", own, "--count", "2", "--out", out, "--no-frames")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {each[:12] for each in ids}


def test_what_has_no_pictures_is_refused_in_a_sentence(asim: Command, own: str, tmp_path: Path) -> None:
    out = str(tmp_path / "out")
    asim("project", "create", f"{own}-grid", "--simulator", "minigrid")
    assert "has no camera: its streams are carried, grid" in asim("export", f"{own}-grid", "ab", "--out", out, status=1)
    assert "no trajectory" in asim("export", own, "f" * 64, "--out", out, status=1)
    assert not (tmp_path / "out").exists()


def test_eight_frames_go_from_the_first_to_the_last() -> None:
    assert chosen_steps(101) == [0, 14, 29, 43, 57, 71, 86, 100]
    assert chosen_steps(3) == [0, 1, 2]
