"""Figure 4d from the command line, on small rooms: runs are told, tables and charts are there, labels stay hidden."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks.paper.minigrid import arms
from benchmarks.paper.minigrid.acquisition import DEFAULT, ArmRun, main
from benchmarks.paper.minigrid.arms import Arm
from benchmarks.paper.minigrid.datasets import draw_labels
from benchmarks.paper.minigrid.loop import Experiment, Plan
from benchmarks.paper.minigrid.rooms import Rooms
from benchmarks.paper.runs import EXPLORATION_CODE, do, result_file
from models.acquisition import Models
from models.acquisition.self_inverse import SelfInverse
from models.families import GridFamily
from models.segments import SegmentBatch
from models.training import TrainingConfig

ARMS = (Arm("random", "top"), DEFAULT, Arm("oracle", "top"), Arm("oracle_easy", "top"))


@pytest.fixture(autouse=True)
def _barely_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GridFamily, "training_config", lambda *_: TrainingConfig(8, 32, 1e-2, 0.5))


@pytest.fixture
def out(small_rooms: Rooms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of finished runs of four arms from one seed."""
    monkeypatch.setattr(Rooms, "of", lambda _: small_rooms)
    for arm in ARMS:
        do(ArmRun(arm, 0, small_rooms, small_rooms.networks(tmp_path)), tmp_path)
    return tmp_path


def test_finished_runs_are_told_in_table_chart_and_figures(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--seeds", "1", "--out", str(out), "--tuning", "--arms", *(arm.name for arm in ARMS)]
    figures = {figure.name: figure for figure in main(options)}
    rows = [line.split("|") for line in capsys.readouterr().out.splitlines()]
    assert [row[0] for row in rows] == ["arm", *(arm.name for arm in ARMS)]
    assert all(len(row) == len(rows[0]) for row in rows)
    assert {"4d_labels_used", "4d_loss_of_random", "4d_loss_of_oracle_top"} <= set(figures)
    assert [figures[f"4d_spearman_overall_round_{number}"].target for number in (1, 2, 3, 4)] == [0.9] * 4
    assert (out / "4d.png").exists()


def test_a_run_tells_each_round_with_its_picks_and_errors(out: Path, small_rooms: Rooms) -> None:
    run = ArmRun(DEFAULT, 0, small_rooms, out / "networks")
    told = json.loads(result_file(out, run).read_text())
    assert [each["labels"] for each in told["rounds"]] == [200, 300, 400, 500]
    assert [len(each["picks"].get("segments", [])) for each in told["rounds"]] == [100, 100, 100, 0]
    picked = [tuple(pick) for each in told["rounds"][:3] for pick in each["picks"]["segments"]]
    assert len(set(picked)) == 300
    assert {"overall", "movement", "interaction", "swap", "left"} <= set(told["rounds"][0]["balanced"])
    assert told["rooms"] == list(small_rooms.words)
    assert told["also"] == []


def test_arms_that_explore_depend_on_its_code(small_rooms: Rooms, tmp_path: Path) -> None:
    exploring = [ArmRun(Arm.parse(name), 0, small_rooms, tmp_path) for name in ("explore:top", "explore_random:top")]
    assert [run.also for run in exploring] == [EXPLORATION_CODE] * 2
    assert [ArmRun(arm, 0, small_rooms, tmp_path).also for arm in ARMS] == [()] * len(ARMS)


@dataclass(frozen=True)
class Peeking(SelfInverse):
    """Fails where it is shown labels that it may not see, or none that it may."""

    name: str = "peeking"

    def actions(self, models: Models, batch: SegmentBatch) -> Tensor:
        """The inferred ones."""
        self._check(batch)
        return super().actions(models, batch)

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,)."""
        self._check(batch)
        return super().score(models, batch, generator)

    def _check(self, batch: SegmentBatch) -> None:
        shown = (batch.actions is not None, batch.action_sets is not None)
        assert shown == (self.privileged, self.privileged)


@pytest.mark.parametrize("privileged", [False, True])
def test_hidden_actions_are_seen_by_the_privileged_alone(
    small_rooms: Rooms, monkeypatch: pytest.MonkeyPatch, privileged: bool
) -> None:
    monkeypatch.setitem(arms.ALL, "peeking", Peeking(privileged=privileged))
    data = small_rooms.load()
    experiment = Experiment(Arm("peeking", "signatures"), 0, data.spaces, data.pool, plan=Plan(40, 20, 1, 100))
    picks = [found.picks for found in experiment.rounds()]
    assert [len(each) for each in picks] == [20, 0]
    if privileged:
        return
    assert data.pool.action_sets is not None
    other = replace(draw_labels(data.pool, _Last()), action_sets=data.pool.action_sets)  # type: ignore[arg-type]  # one method
    again = [found.picks for found in replace(experiment, pool=other).rounds()]
    assert torch.equal(picks[0], again[0])  # whatever the first of each set is


class _Last:
    """Chooses the last of what there is."""

    def choice(self, options: Sequence[int]) -> int:
        """The last."""
        return options[-1]
