"""The commands against a running service: what they print, and what a mistake costs the user: one sentence."""

import json
import re
import sys
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest

from asim.cli import main
from asim.client import Client


class Asim(Protocol):
    """The command line in this process."""

    def __call__(self, *arguments: str, status: int = 0) -> str: ...


SPACES = {
    "observations": {"grid": {"dtype": "uint8", "shape": [6, 6, 3]}, "carried": {"dtype": "uint8", "shape": [3]}},
    "actions": {"kind": "discrete", "n": 7},
}


@pytest.fixture
def asim(url: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Asim:
    """Runs one command; returns what it printed, on stderr where it has to fail."""
    monkeypatch.setenv("ASIM_URL", url)

    def run(*arguments: str, status: int = 0) -> str:
        monkeypatch.setattr(sys, "argv", ["asim", *arguments])
        with pytest.raises(SystemExit) as end:
            main()
        printed, complained = capsys.readouterr()
        assert (end.value.code or 0) == status, printed + complained
        return printed if status == 0 else complained

    return run


def recording(path: Path, seed: int, *, labeled: bool) -> Path:
    """Twelve transitions of noise in the spaces above."""
    generator = np.random.default_rng(seed)
    arrays = {
        "grid": generator.integers(0, 2, (13, 6, 6, 3), dtype=np.uint8),
        "carried": generator.integers(0, 2, (13, 3), dtype=np.uint8),
    }
    actions = {"actions": generator.integers(0, 7, 12)} if labeled else {}
    np.savez(path, **arrays, **actions)
    return path


@pytest.fixture
def own(asim: Asim, tmp_path: Path) -> str:
    """A project of the user's own environment, named after the test's folder."""
    (tmp_path / "spaces.json").write_text(json.dumps(SPACES))
    asim("project", "create", tmp_path.name, "--spaces", str(tmp_path / "spaces.json"), "--round-labels", "0")
    return tmp_path.name


def test_recordings_are_imported_once_and_labeled_ones_with_their_labels(
    asim: Asim, url: str, own: str, tmp_path: Path
) -> None:
    plain = [str(recording(tmp_path / f"{seed}.npz", seed, labeled=False)) for seed in range(3)]
    labeled = str(recording(tmp_path / "labeled.npz", 9, labeled=True))
    printed = asim("import", own, *plain, labeled, "--split", "pool")
    assert printed.count(": created ") == 3
    assert "1 labeled files: 12 labels, 0 known before" in printed
    again = asim("import", own, *plain, labeled, "--split", "pool")
    assert again.count(": duplicate ") == 3
    assert "0 labels, 12 known before" in again
    counts = json.loads(asim("project", "show", own))["counts"]
    assert (counts["pool_trajectories"], counts["pool_segments"], counts["labeled"]) == (4, 48, 12)
    with Client(url) as client, np.load(labeled) as file:
        project = client.find_project(own)
        stored = {label.start: label.actions for label in client.labels(project.id)}
        assert stored == {start: [action] for start, action in enumerate(file["actions"].tolist())}


def test_a_policy_is_changed_field_by_field(asim: Asim, own: str) -> None:
    policy = json.loads(asim("project", "set", own, "--strategy", "random", "--label-budget", "5"))
    assert (policy["strategy"], policy["label_budget"], policy["round_labels"]) == ("random", 5, 0)
    assert re.search(rf"{own} .* random .* 5\b", asim("project", "list"))


def test_mistakes_cost_one_sentence(asim: Asim, own: str, tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("no npz")
    mistakes = {
        ("project", "show", "nothing"): "no project is named 'nothing'",
        ("project", "create", own, "--simulator", "minigrid"): f"a project '{own}' exists already",
        ("project", "create", "x", "--simulator", "minigrit"): "'minigrit' is not one of ['minigrid']",
        ("project", "create", "x", "--simulator", "minigrid", "--option", "size"): "'size' is not of the form",
        ("project", "create", "x", "--spaces", str(tmp_path / "none.json")): "No such file or directory",
        ("project", "set", own, "--strategy", "best"): "strategy: Input should be 'random'",
        ("import", own, str(tmp_path / "text.npz")): "not an npz file",
        ("acquire", own, "--strategy", "best"): "best",
        ("acquire", own, "--count", "7"): "asked for 7 segments",
        ("label", own): "names no simulator",
        ("collect", own, "--transitions", "5"): "names no simulator",
        ("round", own): "has no pool labels to train on",
        ("error", own, "nothing"): "no project is named 'nothing'",
    }
    for arguments, sentence in mistakes.items():
        said = asim(*arguments, status=1)
        assert sentence in said, (arguments, said)
        assert said.startswith("asim: ")
        assert said.count("\n") == 1, said


def test_where_nothing_listens_the_url_is_named(asim: Asim) -> None:
    said = asim("project", "list", "--url", "http://127.0.0.1:9", status=1)
    assert said.startswith("asim: no answer from http://127.0.0.1:9 to GET /projects")


def test_the_error_of_a_project_without_rounds_is_an_empty_table(asim: Asim, own: str, tmp_path: Path) -> None:
    picture = tmp_path / "curve.png"
    assert "test loss" in asim("error", own, "--plot", str(picture))
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert json.loads(asim("error", own, "--json"))["points"] == []
