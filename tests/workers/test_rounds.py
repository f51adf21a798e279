"""A round stores each stage as it is done, survives whatever happens between two of them, and never spoils the last."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from api_schemas.rounds import Round
from asim.errors import Conflict
from models import checkpoints
from models.training import TrainingState
from service import jobs, reaper, registry
from service.store.queries import rows
from service.store.tables import ModelVersionRow
from tests.workers.conftest import OpenLoop, new_project
from tests.workers.in_process import Loop, segments_of
from workers import training
from workers.dispatch import run_job, run_next
from workers.stage import Stage
from workers.training import BASE

Train = Callable[..., TrainingState]
STAGES = ["inverse_dynamics", "world_model", "evaluation", "diagnostics"]


def hashes(loop: Loop, of: Round) -> dict[str, str]:
    """By stage, the hash of the weights that a round has registered."""
    return {name: loop.client.model(model).sha256 for name, model in of.models.items()}


def start(loop: Loop) -> Round:
    """A round whose job waits."""
    return loop.client.start_round(loop.project.id)


def interrupt(
    patch: pytest.MonkeyPatch, number: int, action: Callable[[], None], owner: object = Stage, name: str = "train"
) -> list[int]:
    """Call `action` before the `number`-th call of `owner`'s `name`; returns the calls, without the generator's."""
    real: Train = getattr(owner, name)
    calls: list[int] = []

    def counted(*args: Any, **kwargs: Any) -> Any:
        if not any(getattr(arg, "kind", None) == "subgoal_generator" for arg in args):
            calls.append(len(calls) + 1)
            if calls[-1] == number:
                action()
        return real(*args, **kwargs)

    patch.setattr(owner, name, counted)
    return calls


def disk_is_full() -> None:
    raise OSError(28, "No space left on device")


def test_a_round_stores_its_stages_and_becomes_current(labeled: Loop) -> None:
    done = labeled.train()
    assert [stage.name for stage in done.stages] == STAGES
    assert (done.status, done.error, done.labels, done.number) == ("current", None, 60, 1)
    assert set(done.models) == BASE
    assert labeled.project.current_round == done.id
    assert done.watermark == labeled.project.label_watermark


def test_registered_hashes_are_those_of_the_weights(trained: Loop) -> None:
    for model in trained.client.models(trained.project.id):
        weights = trained.client.weights(model.id)
        assert hashlib.sha256(weights).hexdigest() == model.sha256
        assert len(weights) == model.bytes
        assert checkpoints.load(weights, expect_kind=model.kind, expect_family="grid").kind == model.kind


def test_model_error_covers_the_held_out_labels(trained: Loop) -> None:
    (point,) = trained.client.model_error(trained.project.id).points
    error = point.model_error
    assert error.transitions == trained.project.counts.held_out_labeled == 14
    assert {name: group.transitions for name, group in error.by_group.items()} == {"movement": 6, "interaction": 8}
    assert error.loss is not None
    assert error.loss > 0


def test_without_held_out_labels_there_is_no_model_error(empty: Loop) -> None:
    empty.collect(200, seed=1, split="pool")
    empty.label(20, "random")
    error = empty.train().model_error
    assert error is not None
    assert (error.transitions, error.loss, error.dynamics_accuracy, error.inverse_accuracy) == (0, None, None, None)


def test_a_job_that_is_brought_twice_runs_once(trained: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = interrupt(monkeypatch, 1, pytest.fail)
    (job,) = trained.jobs("train_round")
    assert not run_job(trained.worker, job.id)
    assert calls == []


def test_a_finished_job_that_runs_again_trains_and_scores_nothing(
    trained: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    (job,) = trained.jobs("train_round")
    (before,) = trained.client.rounds(trained.project.id)
    trained.requeue(job.id)
    calls = interrupt(monkeypatch, 1, pytest.fail)
    assert trained.drain() == 1
    (after,) = trained.client.rounds(trained.project.id)
    assert (after.models, after.stages, after.status) == (before.models, before.stages, "current")
    assert calls == []
    assert len(trained.jobs("score_shard")) == len(trained.jobs("merge_scores")) == 2  # the seeds' and the round's


@pytest.mark.parametrize("name", ["train", "model_error"])
def test_a_crash_keeps_the_stages_before_it(
    labeled: Loop, undisturbed: dict[str, str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    asked = start(labeled)
    if name == "train":
        calls = interrupt(monkeypatch, 2, disk_is_full)
    else:
        calls = interrupt(monkeypatch, 1, disk_is_full, training, name)
    run_next(labeled.worker)
    crashed = labeled.client.round(asked.id)
    (job,) = labeled.jobs("train_round")
    kept = STAGES[: 1 if name == "train" else 2]
    assert [stage.name for stage in crashed.stages] == list(crashed.models) == sorted(crashed.models) == kept
    assert (job.state, job.attempts, job.error) == ("queued", 1, "OSError: [Errno 28] No space left on device")
    labeled.clock.advance(10)
    labeled.drain()
    resumed = labeled.client.round(asked.id)
    assert resumed.status == "current"
    assert [stage.name for stage in resumed.stages] == STAGES
    assert all(resumed.models[stage] == crashed.models[stage] for stage in kept)
    assert len(calls) == (3 if name == "train" else 2)
    assert hashes(labeled, resumed) == {kind: undisturbed[kind] for kind in BASE}


def test_weights_without_a_row_are_trained_again(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    real, calls = registry.register, []

    def register(*args: Any) -> ModelVersionRow:
        calls.append(args)
        if len(calls) == 2:
            disk_is_full()
        return real(*args)

    monkeypatch.setattr(registry, "register", register)
    asked = start(labeled)
    run_next(labeled.worker)  # no drain: the pause before the next attempt may pass meanwhile
    assert list(labeled.client.round(asked.id).models) == ["inverse_dynamics"]
    labeled.clock.advance(10)
    labeled.drain()
    assert set(labeled.client.round(asked.id).models) == BASE


def test_a_worker_that_stops_gives_the_round_back_uncounted(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = start(labeled)
    calls = interrupt(monkeypatch, 2, labeled.worker.stopping.set)
    run_next(labeled.worker)
    (job,) = labeled.jobs("train_round")
    assert (job.state, job.attempts, job.error) == ("queued", 0, None)
    assert list(labeled.client.round(asked.id).models) == ["inverse_dynamics"]
    labeled.drain(labeled.another_worker())
    assert labeled.client.round(asked.id).status == "current"
    assert len(calls) == 3  # the stopped stage again


def test_what_a_silent_worker_writes_after_its_lease_is_refused(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = start(labeled)

    def another_finishes_it() -> None:
        labeled.clock.advance(100)
        reaper.reap(labeled.worker.database, labeled.clock())
        labeled.clock.advance(2)
        labeled.drain(labeled.another_worker())

    calls = interrupt(monkeypatch, 1, another_finishes_it)
    run_next(labeled.worker)
    done = labeled.client.round(asked.id)
    (job,) = labeled.jobs("train_round")
    assert (done.status, [stage.name for stage in done.stages]) == ("current", STAGES)
    assert (job.state, job.attempts) == ("done", 1)  # a stage was stored: attempts count from there
    assert len(calls) == 3
    assert len({model.id for model in labeled.client.models(labeled.project.id) if model.round == asked.id}) == 2


def test_a_round_whose_attempts_are_used_up_fails_and_the_older_one_stays(
    opened: OpenLoop, trained_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = opened(trained_folder, job_max_attempts=2)
    before = loop.project.current_round
    loop.label(5)
    monkeypatch.setattr(Stage, "train", lambda *_: disk_is_full())
    asked = start(loop)
    for _ in range(3):
        loop.drain()
        loop.clock.advance(100)
    failed, job = loop.client.round(asked.id), loop.jobs("train_round")[-1]
    assert (failed.status, job.state, job.attempts) == ("failed", "failed", 2)
    assert failed.error == f"job {job.id} (train_round): OSError: [Errno 28] No space left on device"
    assert loop.project.current_round == before
    assert loop.acquire(3).round == before


def test_a_worker_that_dies_every_time_fails_the_round(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = start(labeled)

    class KilledError(BaseException):
        pass

    def die(*_: Any) -> None:
        raise KilledError

    monkeypatch.setattr(Stage, "train", die)
    for _ in range(3):
        with pytest.raises(KilledError):
            run_next(labeled.worker)
        labeled.clock.advance(100)
        reaper.reap(labeled.worker.database, labeled.clock())
        labeled.clock.advance(100)
    failed = labeled.client.round(asked.id)
    assert failed.status == "failed"
    assert failed.error is not None
    assert "fell silent in attempt 3 of 3" in failed.error


def test_projects_of_equal_seed_and_data_start_alike(empty: Loop) -> None:
    empty.collect(50, seed=9, split="pool")  # so that the rows of the two projects are numbered apart
    seeds, weights = [], []
    for name in ("one", "two"):
        empty.name = name
        new_project(empty, seed=7)
        empty.collect(200, seed=1, split="pool")
        seeds.append(segments_of(empty.label(20, "random", seed=4)))
        weights.append(hashes(empty, empty.train()))
    assert seeds[0] == seeds[1]
    assert weights[0] == weights[1]


def test_projects_of_another_seed_start_otherwise(opened: OpenLoop) -> None:
    seeds = []
    for seed in (7, 8):
        loop = opened()
        new_project(loop, seed=seed)
        loop.collect(200, seed=1, split="pool")
        seeds.append(segments_of(loop.acquire(20, "random")))
    assert set(seeds[0]) != set(seeds[1])


@pytest.mark.parametrize("status", ["cancelled", "failed", "superseded"])
def test_a_round_that_ended_while_it_was_evaluated_is_not_scored(
    labeled: Loop, monkeypatch: pytest.MonkeyPatch, status: str
) -> None:
    asked = start(labeled)
    calls = interrupt(
        monkeypatch, 1, lambda: labeled.set_row("round", asked.id, status=status), training, "model_error"
    )
    before = len(labeled.jobs("score_shard"))
    labeled.drain()
    assert len(calls) == 1
    assert labeled.client.round(asked.id).status == status
    assert len(labeled.jobs("score_shard")) == before
    (job,) = labeled.jobs("train_round")
    assert (job.state, job.result) == ("done", {"round": str(asked.id), "status": status})


def test_a_rounds_rows_are_locked_after_its_projects(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order of all: who had it the other way round would deadlock with an acquire or a cancellation."""
    start(labeled)
    locked: list[tuple[Any, str]] = []  # the sessions themselves: the address of one that is gone may come back
    get = rows.get

    def noted(session: Any, row: type[Any], key: object, *, lock: bool = False) -> Any:
        if lock:
            locked.append((session, row.__name__))
        return get(session, row, key, lock=lock)

    monkeypatch.setattr(rows, "get", noted)
    run_next(labeled.worker)
    by_session = [[name for each, name in locked if each is session] for session, _ in locked]
    several = [names for names in by_session if len(set(names)) > 1]
    assert several
    assert all(names.index("ProjectRow") < names.index("RoundRow") for names in several if "RoundRow" in names)


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_a_queue_is_ranked_before_the_next_round_trains(labeled: Loop) -> None:
    first = start(labeled)
    run_next(labeled.worker)  # the first round has trained; its scoring waits
    labeled.label(10, "random")
    second = start(labeled)
    run_next(labeled.worker)
    run_next(labeled.worker)
    assert [labeled.client.round(asked.id).status for asked in (first, second)] == ["current", "queued"]


def test_an_overtaken_round_trains_nothing(labeled: Loop) -> None:
    first = start(labeled)
    labeled.label(10, "random")
    second = start(labeled)
    labeled.drain()
    assert [labeled.client.round(asked.id).status for asked in (first, second)] == ["superseded", "current"]
    assert {model.round for model in labeled.client.models(labeled.project.id)} == {second.id, None}


def test_attempts_are_counted_from_the_last_stored_stage(labeled: Loop) -> None:
    asked = start(labeled)
    for _ in range(2 * labeled.settings.job_max_attempts):
        with labeled.worker.database.write() as session:
            row = jobs.claim_next(session, ("train",), "killed", labeled.clock(), 15.0)
            assert row is not None
            jobs.made_progress(session, jobs.lease_of(row))
        labeled.clock.advance(100)  # the worker says nothing more
        reaper.reap(labeled.worker.database, labeled.clock())
        labeled.clock.advance(100)
    labeled.drain()
    assert labeled.client.round(asked.id).status == "current"


def test_who_cancels_a_round_by_its_training_that_is_done_is_told_which_job_is_at_work(labeled: Loop) -> None:
    asked = start(labeled)
    assert asked.job is not None
    run_next(labeled.worker)
    shard = next(job for job in labeled.client.jobs(labeled.project.id) if job.kind == "score_shard")
    with pytest.raises(Conflict, match=rf"job {asked.job} is done; its round goes on in job {shard.id}$"):
        labeled.client.cancel_job(asked.job)
    labeled.client.cancel_job(shard.id)
    assert labeled.client.round(asked.id).status == "cancelled"
    with pytest.raises(Conflict, match="there is nothing left to cancel"):
        labeled.client.cancel_job(asked.job)
