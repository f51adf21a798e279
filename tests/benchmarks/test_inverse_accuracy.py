"""Figure 4a from the command line, and what it says a service would say."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest

from benchmarks.paper.minigrid import composition, foreign
from benchmarks.paper.minigrid.datasets import TUNING
from benchmarks.paper.minigrid.inverse_accuracy import FORMS, TARGETS, AccuracyRun, Draw, figures, main
from benchmarks.paper.runs import Json, do
from models.families import GridFamily
from models.training import TrainingConfig
from tests.benchmarks.transitions import transitions
from workers.simulators.minigrid_rules import ACTION_NAMES

Finish = Callable[[Sequence[Draw], Path | None], list[str]]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sets, made once."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture
def finished(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Finish:
    """Options of runs with 35 labels that are finished: barely trained, in this process."""
    monkeypatch.setattr(composition, "POOL", 400)
    monkeypatch.setattr(GridFamily, "training_config", lambda *_: TrainingConfig(20, 32, 1e-2, 0.5))

    def finish(draws: Sequence[Draw], seed_set: Path | None = None) -> list[str]:
        labels = 35 if seed_set is None else foreign.read(seed_set).size
        for form, draw in product(FORMS, draws):
            run = AccuracyRun(form, draw, labels, 0, data, tuning=True, seed_set=seed_set)
            do(replace(run, per_action=8), tmp_path)
        return ["--labels", "35", "--seeds", "1", "--tuning", "--out", str(tmp_path)]

    return finish


def test_all_forms_are_told_and_the_sparse_one_has_the_targets(
    finished: Finish, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = {figure.name: figure for figure in main(finished(["balanced", "uniform"], None))}
    assert set(told) == {f"4a_{form}_{action}" for form, action in product(FORMS, TARGETS)}
    assert {name: each.target for name, each in told.items() if each.target is not None} == {
        f"4a_sparse_{action}": target for action, target in TARGETS.items()
    }
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[:3] for line in lines[1:9]] == [
        [form, draw, "35"] for form, draw in product(FORMS, ("balanced", "uniform"))
    ]
    # 35 of 400 steps as they come hold hardly an interaction: the service says so, in words.
    assert any(
        line.startswith("uniform, 35 labels, 1 of 1 seeds: The inverse model knows too little") for line in lines
    )
    assert (tmp_path / "4a.png").read_bytes().startswith(b"\x89PNG")


def test_uniform_labels_alone_have_no_target(finished: Finish) -> None:
    assert main([*finished(["uniform"], None), "--draws", "uniform"]) == []


def test_a_files_labels_are_one_set_that_was_drawn_by_nobody_here(
    finished: Finish, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = transitions("random", 60, TUNING + 800_000)
    path = tmp_path / "labels.npz"
    foreign.write(labels.take(foreign.fits(labels).nonzero().flatten()), path)
    told = main([*finished(["given"], path), "--seed-set", str(path)])
    assert {figure.name for figure in told if figure.target} == {f"4a_sparse_{action}" for action in TARGETS}
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[:2] for line in lines[1:5]] == [[form, "given"] for form in FORMS]


def test_of_an_action_that_a_test_lacks_nothing_is_told() -> None:
    accuracy = dict.fromkeys(ACTION_NAMES, 1.0) | {"swap": None}
    found: list[Json] = [{"form": "sparse", "draw": "balanced", "labels": 7, "accuracy": accuracy}]
    assert [figure.name for figure in figures(found, 7)] == ["4a_sparse_pickup", "4a_sparse_drop", "4a_sparse_toggle"]
