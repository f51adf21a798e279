"""Figure 5 on robots, hardly trained: runs are told, equal budgets bind, episodes fill their segments."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.paper.robots import cost, distances, networks
from benchmarks.paper.robots.__main__ import main, recordings_of, runs_of
from benchmarks.paper.robots.acquisition_table import jaccard, tell
from benchmarks.paper.robots.arms import MANY, RobotArm
from benchmarks.paper.robots.datasets import LENGTH, PolicyTraining, RecordingRun, load, windows
from benchmarks.paper.robots.profiles import PROFILES, QUICK, Profile, TaskPlan
from benchmarks.paper.runs import Json, do, result_file
from models import checkpoints
from models.families import ROBOT
from models.training import TrainingConfig, TrainingState, advance
from tests.science import toy_robot
from workers.simulators.base import SimulatorUnavailable
from workers.simulators.catalog import make_simulator

TINY = replace(QUICK, tasks=(TaskPlan("maniskill", "PullCube", 2, 2, 4, 3),), warm=(4,), batch=2, demonstrations=2)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of finished runs of every arm of the profile."""
    try:
        make_simulator("maniskill", {"cameras": False}).close()
    except SimulatorUnavailable as error:
        pytest.skip(str(error))
    root = tmp_path_factory.mktemp("robots")
    folder, data, threads = root / TINY.name, root / TINY.name / "data", torch.get_num_threads()
    torch.set_num_threads(1)  # as the benchmark has it: networks as small as these only wait for each other's threads
    do(PolicyTraining(TINY.policy(TINY.tasks[0]), data), data)
    for recording in recordings_of(TINY):
        do(RecordingRun(recording, data), data)
    for run in runs_of(TINY, folder, "cpu"):
        do(run, folder)
    torch.set_num_threads(threads)
    return root


def test_finished_runs_are_told(out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(PROFILES, TINY.name, TINY)
    figures = {figure.name for figure in main(["--profile", "quick", "--out", str(out)])}
    shown = capsys.readouterr().out
    assert {"5_PullCube_4_cycle:signatures_of_random", "5_PullCube_4_all_of_random"} <= figures
    assert "5_PullCube_4_oracle:signatures_spearman_own" in figures
    for line in ("the whole pool labeled", "chosen by the true loss", "in common (Jaccard)", "standing still"):
        assert line in shown
    assert (out / TINY.name / "5-PullCube-4.png").exists()


def test_distances_are_compared_on_one_model(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PROFILES, TINY.name, TINY)
    networks_of = out / TINY.name / "networks"
    kept = sorted(networks_of.rglob("*.safetensors"))
    asked = ["--profile", "quick", "--task", "PullCube", "--out", str(out)]
    figures = {figure.name: figure.value for figure in distances.main(asked)}
    assert sorted(networks_of.rglob("*.safetensors")) == kept  # those of the benchmark
    names = {f"{form}_{actions}" for form in ("divergence", "decoded") for actions in ("true", "inferred")}
    assert {name.rpartition("_")[0] for name in figures} == names
    assert all(-1.0 <= value <= 1.0 for value in figures.values())
    assert distances.worst_found(torch.tensor([3.0, 1.0, 2.0]), torch.tensor([3.0, 2.0, 1.0]), 2) == 0.5


def test_budgets_bind_and_nothing_is_labeled_twice(out: Path) -> None:
    told = {run.arm.name: _told(run_file) for run, run_file in _files(out)}
    for arm, result in told.items():
        labels = [each["labels"] for each in result["rounds"]]
        step = result["pool"] if arm == "all" else TINY.batch
        assert labels[1] - labels[0] == step
        assert labels[2] - labels[1] == (0 if arm == "all" else TINY.batch)
        picked = [tuple(segment) for each in result["rounds"] for segment in each["picks"]["segments"]]
        assert len(picked) == len(set(picked)) == (0 if arm == "all" else 2 * TINY.batch)
    assert len({json.dumps(result["rounds"][0]["errors"]) for result in told.values()}) == 1  # one warm-up
    assert all(result["rounds"][0]["ranks"]["own"] > 0.999 for arm, result in told.items() if arm.startswith("oracle"))


def test_later_networks_are_not_kept_and_the_first_ones_are(out: Path) -> None:
    (folder,) = (out / TINY.name / "networks").iterdir()
    assert [each.name for each in folder.iterdir()] == ["quick-PullCube-4-0"]


def test_episodes_fill_whole_segments(out: Path) -> None:
    data, task = out / TINY.name / "data", TINY.tasks[0]
    for recording in recordings_of(TINY):
        told = RecordingRun(recording, data).results()
        assert all(length % LENGTH == 0 for length in told["lengths"])
    expert = load([TINY.expert(task)], data)
    assert expert.size == 2  # a pull takes a dozen steps
    with np.load(TINY.expert(task).file(data)) as arrays:
        assert arrays["solved"].all()
        assert torch.equal(expert.observations["proprioception"][1, 0], torch.from_numpy(arrays["proprioception"][26]))
        assert expert.actions is not None
        assert torch.equal(expert.actions[1], torch.from_numpy(arrays["actions"][LENGTH:]))
    tests = windows([TINY.validating(task)], data, 32)
    assert {name.start for name in tests.segments} == {0, 18}


def test_the_estimate_counts_what_is_missing(tmp_path: Path) -> None:
    runs = runs_of(TINY, tmp_path, "cpu")[:1]
    assert "1 runs and 4 recordings are missing" in cost.told(TINY, runs, recordings_of(TINY), "cpu", 2)
    many = runs_of(replace(TINY, seeds=3), tmp_path, "cpu")
    assert len({run.name for run in many}) == 3 * len(TINY.arms)


def test_a_training_that_was_stopped_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points, config = toy_robot.points(20, 8, seed=0), TrainingConfig(6, 4, 1e-3, 0.0)
    monkeypatch.setattr(networks, "SLICE", 2)

    def trained(path: Path) -> bytes:
        generator = torch.Generator().manual_seed(0)
        network = ROBOT.build("world_model", toy_robot.POINT, {}, generator)
        networks.trained(network, points, points.without_labels(), config, generator, "cpu", path)
        return path.read_bytes()

    whole = trained(tmp_path / "whole.safetensors")
    monkeypatch.setattr(networks, "SAVED_EVERY", -1.0)
    with monkeypatch.context() as patch:
        patch.setattr(networks, "advance", Interrupted())
        with pytest.raises(KeyboardInterrupt):
            trained(tmp_path / "stopped.safetensors")
    assert (tmp_path / "stopped.training").exists()
    assert trained(tmp_path / "stopped.safetensors") == whole
    assert not (tmp_path / "stopped.training").exists()
    assert checkpoints.describe(whole)["kind"] == "world_model"


class Interrupted:
    """Trains twice, then is interrupted."""

    def __init__(self) -> None:
        self._left = 2

    def __call__(self, *args: Any, **named: Any) -> TrainingState:
        """As `advance`."""
        self._left -= 1
        if self._left < 0:
            raise KeyboardInterrupt
        return advance(*args, **named)


def test_partial_figures_say_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = [_result("random:top", 0, 0.02, "ab"), _result("cycle:signatures", 0, 0.01, "bc")]
    figures = {figure.name: figure for figure in tell(found, 6, tmp_path)}
    figure = figures["5_Lift_60_cycle:signatures_of_random"]
    assert figure.value == pytest.approx(0.5)
    assert "partial: 2 of 6 runs" in figure.unit
    assert figure.target is None
    assert "partial: 2 of 6 runs" in capsys.readouterr().out
    whole = {figure.name: figure for figure in tell(found, 2, tmp_path)}
    assert whole["5_Lift_60_cycle:signatures_of_random"].target == 0.87


def test_what_arms_pick_alike() -> None:
    left, right = {0: _result("a", 0, 1.0, "abc")}, {0: _result("b", 0, 1.0, "bcd"), 1: _result("b", 1, 1.0, "x")}
    assert jaccard(left, right) == [pytest.approx(2 / 4)]


def test_arms_that_robots_do_not_have_are_refused() -> None:
    assert [RobotArm.parse(name).name for name in ("random", "cycle", "oracle:top", "all")] == [
        "random:top",
        "cycle:signatures",
        "oracle:top",
        "all",
    ]
    assert {"uncertainty", "progress", "fidelity", "masked_cycle"} <= set(MANY)
    with pytest.raises(ValueError, match="tries every action"):
        RobotArm.parse("self_inverse")
    with pytest.raises(ValueError, match="strategy must be one of"):
        RobotArm.parse("nonsense")


@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda profile: profile.name)
def test_the_validating_stage_is_in_neither(profile: Profile) -> None:
    for task in profile.tasks:
        stages = [recording.stage for recording in profile.pool(task)]
        assert profile.validates not in stages
        assert profile.stages not in stages
        assert len(stages) == profile.stages - 2
        assert max(profile.warm) <= 2 * min(task.expert, task.best)


def _files(out: Path) -> list[tuple]:  # type: ignore[type-arg]  # a run and its file
    folder = out / TINY.name
    return [(run, result_file(folder, run)) for run in runs_of(TINY, folder, "cpu")]


def _told(path: Path) -> Json:
    told: Json = json.loads(path.read_text())
    return told


def _result(arm: str, seed: int, error: float, picks: str) -> Json:
    errors = {str(horizon): {"pixels": error, "proprioception": error} for horizon in (8, 32)}
    told = {"labels": 10, "errors": errors, "ranks": {"own": 0.5}, "inverse": None}
    chosen = {"segments": [[name, 0] for name in picks], "sources": {"stage 1": len(picks)}}
    rounds = [told | {"picks": chosen}, told | {"labels": 20, "picks": {"segments": [], "sources": {}}}]
    return {"task": "Lift", "warm": 60, "arm": arm, "seed": seed, "still": errors, "rounds": rounds}
