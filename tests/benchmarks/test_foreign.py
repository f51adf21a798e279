"""The foreign layout: what is written reads back, in either order of the axes; what is malformed is named."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from benchmarks.paper.minigrid import foreign
from benchmarks.paper.minigrid.datasets import TUNING
from models.segments import SegmentBatch
from tests.benchmarks.transitions import transitions

Arrays = dict[str, NDArray[Any]]


@pytest.fixture(scope="module")
def batch() -> SegmentBatch:
    """Steps of real rooms, those left out whose hand holds a full box, which the layout cannot hold."""
    everything = transitions("mixture", 600, TUNING + 500_000)
    return everything.take(torch.nonzero((everything.observations["carried"][..., 2] == 0).all(1)).flatten())


@pytest.fixture
def path(batch: SegmentBatch, tmp_path: Path) -> Path:
    """A file of them."""
    foreign.write(batch, tmp_path / "test.npz")
    return tmp_path / "test.npz"


def test_what_is_written_reads_back(batch: SegmentBatch, path: Path) -> None:
    _same(foreign.read(path), batch)


def test_rooms_with_their_axes_the_other_way_round_read_the_same(batch: SegmentBatch, path: Path) -> None:
    arrays = _arrays(path)
    for name in ("states", "next_states"):
        arrays[name] = arrays[name].swapaxes(1, 2)
    _same(foreign.read(_saved(path, arrays)), batch)


def test_single_axes_in_the_middle_are_left_out(batch: SegmentBatch, path: Path) -> None:
    arrays = {name: array if name == "actions" else array[:, None, None] for name, array in _arrays(path).items()}
    _same(foreign.read(_saved(path, arrays)), batch)


def test_an_empty_hand_is_written_as_grey_and_empty(batch: SegmentBatch, path: Path) -> None:
    empty = (batch.observations["carried"][:, 0] == torch.tensor((1, 0, 0))).all(1).numpy()
    assert 0 < empty.sum() < len(empty)
    assert (_arrays(path)["carried"][empty] == (5, 1)).all()


def test_segments_are_named_by_the_files_contents(path: Path) -> None:
    names = foreign.read(path).segments
    assert names[3].start == 3
    assert names[3].trajectory.startswith("test-")
    assert len({name.trajectory for name in names}) == 1


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("actions", lambda actions: actions[:-1], r"actions must be \(\d+,\)"),
        ("actions", lambda actions: actions + 7, "actions must be 0 to 6, it holds"),
        ("actions", lambda actions: actions + 0.5, "actions must be 0 to 6, it holds"),
        ("states", lambda states: states[..., :2], r"states must be \(N, H, H, 3\)"),
        ("states", lambda states: states[:, :-1], r"states must be \(N, H, H, 3\)"),
        ("states", lambda states: states + 11, r"states\[\.\.\., 0\] must be 0 to 10, it holds"),
        ("next_states", lambda states: states.astype(np.float64) - 0.5, r"next_states\[\.\.\., 0\] must be 0 to 10"),
        ("next_states", lambda states: np.concatenate([states, states[:1]]), "next_states is"),
        ("carried", lambda hand: hand[:-1], r"carried must be \(\d+, 2\)"),
        ("next_carried", lambda hand: hand[:, ::-1] + 6, r"next_carried\[\.\.\., 0\] must be 0 to 5, it holds"),
    ],
)
def test_a_malformed_array_is_named_with_its_value(path: Path, name: str, change: Any, message: str) -> None:
    arrays = _arrays(path)
    with pytest.raises(foreign.ForeignLayoutError, match=message):
        foreign.read(_saved(path, arrays | {name: change(arrays[name])}))


@pytest.mark.parametrize("name", foreign.NAMES)
def test_a_missing_array_is_named(path: Path, name: str) -> None:
    arrays = _arrays(path)
    del arrays[name]
    with pytest.raises(foreign.ForeignLayoutError, match=f"lacks the array '{name}'"):
        foreign.read(_saved(path, arrays))


def test_what_is_no_npz_and_what_is_no_file_are_told(tmp_path: Path) -> None:
    bad = tmp_path / "bad.npz"
    bad.write_bytes(b"hello")
    for path in (bad, tmp_path / "missing.npz"):
        with pytest.raises(foreign.ForeignLayoutError, match=f"{path.name} cannot be read"):
            foreign.read(path)


def test_a_carried_full_box_is_not_written_as_an_empty_one(batch: SegmentBatch, tmp_path: Path) -> None:
    hand = batch.observations["carried"].clone()
    hand[5, 1] = torch.tensor((7, 0, 2))
    full = SegmentBatch({"grid": batch.observations["grid"], "carried": hand}, batch.actions)
    with pytest.raises(ValueError, match="segment 5: a full box"):
        foreign.write(full, tmp_path / "full.npz")


def test_unlabeled_transitions_are_not_written(batch: SegmentBatch, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="labeled transitions"):
        foreign.write(batch.without_labels(), tmp_path / "unlabeled.npz")


def _arrays(path: Path) -> Arrays:
    with np.load(path) as file:
        return dict(file)


def _saved(path: Path, arrays: Mapping[str, NDArray[Any]]) -> Path:
    named: Any = dict(arrays)
    np.savez(path, **named)
    return path


def _same(left: SegmentBatch, right: SegmentBatch) -> None:
    assert left.actions is not None
    assert right.actions is not None
    assert torch.equal(left.actions, right.actions)
    for name, stream in right.observations.items():
        assert torch.equal(left.observations[name], stream)
