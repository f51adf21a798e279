"""A file in the foreign layout gives the numbers of the steps that it was made of; results bear what files hold."""

from argparse import ArgumentTypeError
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.paper.minigrid.datasets import TUNING
from benchmarks.paper.minigrid.foreign_path import accuracy, compared, errors_of
from benchmarks.paper.minigrid.inverse_accuracy import AccuracyRun
from benchmarks.paper.minigrid.loop import Plan
from benchmarks.paper.minigrid.rooms import Rooms, data_seed
from models.families import GridFamily
from models.training import TrainingConfig
from tests.benchmarks.transitions import transitions


@pytest.fixture(autouse=True)
def _barely_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GridFamily, "training_config", lambda *_: TrainingConfig(30, 32, 1e-2, 0.5))


def test_4d_gives_the_same_numbers(small_rooms: Rooms, tmp_path: Path) -> None:
    figures = {each.name: each for each in errors_of(small_rooms, 0, tmp_path, tmp_path / "file.npz", Plan(40, 20, 1))}
    assert figures["4d_file_transitions"].value > 50
    assert figures["4d_file_numbers"].value == 5 * 10  # count and four errors, of all, two groups and seven actions
    assert figures["4d_file_largest_difference"].value == 0


def test_4a_gives_the_same_numbers(tmp_path: Path) -> None:
    run = AccuracyRun("sparse", "balanced", 35, 0, tmp_path, tuning=True, per_action=10)
    figures = {each.name: each for each in accuracy(run, tmp_path / "file.npz")}
    assert figures["4a_file_numbers"].value == 7
    assert figures["4a_file_largest_difference"].value == 0


def test_a_number_that_only_one_side_has_is_a_difference(small_rooms: Rooms) -> None:
    test = transitions("random", 3, TUNING + 900_000)
    assert compared("4d", test, {"loss": 1.0, "exact": None}, {"loss": 1.25, "exact": None})[-1].value == 0.25
    assert not compared("4d", test, {"loss": 1.0}, {"loss": None})[-1].met


def test_results_bear_the_contents_of_files_not_their_names(tmp_path: Path) -> None:
    for name, content in (("a.npz", b"one"), ("b.npz", b"one"), ("other/a.npz", b"two")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    a, b, other = (tmp_path / name for name in ("a.npz", "b.npz", "other/a.npz"))
    rooms = Rooms(tmp_path, tuning=True)
    words = [replace(rooms, test_set=path).words for path in (a, b, other)]
    assert words[0] == words[1] != words[2]
    assert len({rooms.words, *words, replace(rooms, pool=a).words, replace(rooms, data_seed=1).words}) == 5
    assert replace(rooms, folder=tmp_path / "elsewhere").words == rooms.words
    run = AccuracyRun("sparse", "given", 3, 0, tmp_path)
    names = [replace(run, test_set=path).name for path in (a, b, other)]
    assert names[0] == names[1] != names[2]


def test_other_rooms_are_neither_those_of_other_figures_nor_for_tuning() -> None:
    assert data_seed("9999") == 9999
    for text in ("10000", "700000", "-1", "x"):
        with pytest.raises(ArgumentTypeError, match=f"must be 0 to 9999, got {text!r}"):
            data_seed(text)
