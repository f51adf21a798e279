"""Figure 8 from results of figure 4d: whose they are, and what they say."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper.minigrid.picked_losses import finished, losses, main
from benchmarks.paper.minigrid.rooms import Rooms
from benchmarks.paper.runs import code_digest


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Two seeds of an arm, one of another; one in rooms for tuning, one on a file's test, one of other code; no run."""
    folder, theirs = tmp_path / "4d", tmp_path / "theirs.npz"
    folder.mkdir()
    theirs.write_bytes(b"rooms")
    _write(folder, "cycle:top", 0, "reported", [1.0, 2.0])
    _write(folder, "cycle:top", 1, "reported", [3.0, 6.0])
    _write(folder, "random:top", 0, "reported", [0.5, 0.5])
    _write(folder, "random:top", 0, "tuning", [100.0])
    _write(folder, "random:top", 1, "reported", [200.0], theirs)
    _write(folder, "random:top", 2, "reported", [300.0], code="other")
    (folder / "other.json").write_text(json.dumps({"name": "other", "code": code_digest()}))
    return folder


def test_only_results_of_the_rooms_in_question_count(results: Path) -> None:
    assert {each["name"] for each in finished(results, False)} == {
        "cycle-top-0-reported",
        "cycle-top-1-reported",
        "random-top-0-reported",
    }
    assert [each["name"] for each in finished(results, True)] == ["random-top-0-tuning"]


def test_seeds_are_pooled_round_by_round_and_the_last_round_has_no_picks(results: Path) -> None:
    found = losses(finished(results, False))
    assert found == {"cycle:top": {1: [1.0, 2.0, 3.0, 6.0]}, "random:top": {1: [0.5, 0.5]}}


def test_the_figure_is_drawn_and_its_median_told(results: Path, tmp_path: Path) -> None:
    figures = {each.name: each.value for each in main(["--results", str(results), "--out", str(tmp_path / "8")])}
    assert figures == {"8_median_cycle:top": float(np.median([1, 2, 3, 6])), "8_median_random:top": 0.5}
    assert (tmp_path / "8" / "8.png").read_bytes().startswith(b"\x89PNG")


def test_without_results_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--results", str(tmp_path), "--out", str(tmp_path / "8")]) == []
    assert "no finished result of figure 4d" in capsys.readouterr().out


def _write(
    folder: Path,
    arm: str,
    seed: int,
    rooms: str,
    true_losses: list[float],
    test_set: Path | None = None,
    code: str | None = None,
) -> None:
    name = f"{arm.replace(':', '-')}-{seed}-{rooms}"
    words = Rooms(folder / "data", rooms == "tuning", test_set=test_set).words
    rounds = [{"picks": {"true_losses": true_losses}}, {"picks": {}}]
    told = {"name": name, "code": code or code_digest(), "arm": arm, "seed": seed, "rooms": words, "rounds": rounds}
    (folder / f"{name}.json").write_text(json.dumps(told))
