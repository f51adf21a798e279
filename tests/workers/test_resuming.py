"""Training inside a round is cut anywhere, goes on in another worker, and ends with the same bits."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import select

from api_schemas.jobs import Job, SelectQueue
from api_schemas.rounds import Round
from models.training import TrainingState, advance
from service import jobs
from service.store.tables import JobRow, ScoringRow
from tests.workers.conftest import STEPS, OpenLoop, new_project
from tests.workers.in_process import Loop
from workers import stage, trainer
from workers.dispatch import run_job, run_next
from workers.stage import Stage
from workers.training import BASE

SLICE = stage.FIRST_STEPS
ALWAYS = {"checkpoint_seconds": 1e-9}


class Slices:
    """Every slice of a round's networks: (kind, first step); `after` a slice, by its number, something happens."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.seen: list[tuple[str, int]] = []
        self.after: dict[int, Callable[[], object]] = {}
        patch.setattr(trainer, "advance", self._advance)
        patch.setattr(stage, "_next_steps", lambda *_: SLICE)

    def _advance(self, network: Any, batch: Any, state: TrainingState, until: int, **more: Any) -> TrainingState:
        done = advance(network, batch, state, until, **more)
        if network.kind != "subgoal_generator":
            self.seen.append((network.kind, state.step))
            self.after.pop(len(self.seen), lambda: None)()
        return done


@pytest.fixture
def slices(monkeypatch: pytest.MonkeyPatch) -> Slices:
    return Slices(monkeypatch)


def job_of(loop: Loop) -> Job:
    return loop.jobs("train_round")[-1]


def row_of(loop: Loop) -> JobRow:
    with loop.worker.database.read() as session:
        return session.get_one(JobRow, job_of(loop).id)


def checkpoints(loop: Loop) -> list[Path]:
    """The stored checkpoints."""
    return [path for path in (loop.folder / "blobs" / "checkpoints").rglob("*") if path.is_file()]


def weights(loop: Loop, asked: Round) -> dict[str, str]:
    found = loop.client.round(asked.id)
    assert found.status == "current"
    return {kind: loop.client.model(found.models[kind]).sha256 for kind in BASE}


def base(undisturbed: dict[str, str]) -> dict[str, str]:
    return {kind: undisturbed[kind] for kind in BASE}


def resumptions(loop: Loop) -> list[tuple[str, int]]:
    """(stage, step) of a round's resumptions. The generator may have its own: it gives way when an attempt is due."""
    rows = [event for event in loop.client.events(loop.project.id) if event.kind == "training.resumed"]
    rows = [event for event in rows if event.data["round"] is not None]
    assert all(event.data["job"] for event in rows)
    return [(str(event.data["stage"]), int(str(event.data["step"]))) for event in rows]


def always_keep(loop: Loop) -> None:
    """A checkpoint before every slice."""
    loop.worker = loop.another_worker(loop.settings.model_copy(update=ALWAYS))


def interrupted(loop: Loop, slices: Slices) -> Round:
    """A round whose worker is stopped after six slices, with a checkpoint."""
    asked = loop.client.start_round(loop.project.id)
    slices.after = {6: loop.worker.stopping.set}
    run_next(loop.worker)
    return asked


def crash() -> None:
    raise OSError(5, "Input/output error")


def whole(kind: str) -> list[tuple[str, int]]:
    return [(kind, step) for step in range(0, STEPS, SLICE)]


def test_a_stopping_worker_loses_no_step(labeled: Loop, slices: Slices, undisturbed: dict[str, str]) -> None:
    asked = interrupted(labeled, slices)
    assert (job_of(labeled).state, job_of(labeled).attempts) == ("queued", 0)
    assert row_of(labeled).checkpoint_stage == "world_model"
    assert len(checkpoints(labeled)) == 1
    labeled.drain(labeled.another_worker())
    assert slices.seen == whole("inverse_dynamics") + whole("world_model")
    assert weights(labeled, asked) == base(undisturbed)
    assert resumptions(labeled) == [("world_model", 2 * SLICE)]
    assert row_of(labeled).checkpoint_sha256 is None
    assert checkpoints(labeled) == []


def test_after_a_crash_it_goes_on_from_the_last_checkpoint(
    labeled: Loop, slices: Slices, undisturbed: dict[str, str]
) -> None:
    always_keep(labeled)
    asked = labeled.client.start_round(labeled.project.id)
    slices.after = {3: crash, 7: crash}
    for _ in range(3):
        labeled.drain()
        labeled.clock.advance(10)
    before = [*whole("inverse_dynamics")[:3], *whole("inverse_dynamics")[2:], ("world_model", 0), ("world_model", 5)]
    assert slices.seen == [*before, *whole("world_model")[1:]]
    assert resumptions(labeled) == [("inverse_dynamics", 10), ("world_model", 5)]
    assert weights(labeled, asked) == base(undisturbed)
    assert checkpoints(labeled) == []


def test_a_checkpoint_that_is_further_counts_the_attempts_anew(labeled: Loop, slices: Slices) -> None:
    always_keep(labeled)
    asked = labeled.client.start_round(labeled.project.id)
    slices.after = {2: crash, 4: crash, 6: crash, 8: crash}  # once more than there are attempts, a slice further each
    for _ in range(8):
        labeled.drain()
        labeled.clock.advance(100)
    assert labeled.client.round(asked.id).status == "current"


def test_without_progress_the_attempts_run_out(labeled: Loop, slices: Slices) -> None:
    asked = labeled.client.start_round(labeled.project.id)
    slices.after = {1: crash, 2: crash, 3: crash}
    for _ in range(4):
        labeled.drain()
        labeled.clock.advance(100)
    assert (labeled.client.round(asked.id).status, job_of(labeled).attempts) == ("failed", 3)


@pytest.mark.parametrize("damage", ["torn", "gone", "foreign"])
def test_a_checkpoint_that_is_no_use_starts_the_stage_anew(
    labeled: Loop, slices: Slices, undisturbed: dict[str, str], damage: str
) -> None:
    asked = interrupted(labeled, slices)
    (path,) = checkpoints(labeled)
    if damage == "torn":
        path.write_bytes(path.read_bytes()[:1000])
    elif damage == "gone":
        path.unlink()
    else:
        foreign = labeled.blobs.put("checkpoints", b"something else")
        labeled.set_row("job", job_of(labeled).id, checkpoint_sha256=foreign)
    labeled.drain(labeled.another_worker())
    assert slices.seen[6:] == whole("world_model")
    assert resumptions(labeled) == []
    assert weights(labeled, asked) == base(undisturbed)


def test_equal_checkpoints_of_two_jobs_are_two_blobs(opened: OpenLoop, slices: Slices) -> None:
    """One job's replaced checkpoint is deleted: the other's, of the same bits, has to stay."""
    loop, asked = opened(), []
    for name in ("one", "two"):
        loop.name = name
        new_project(loop, seed=7)
        loop.collect(200, seed=1, split="pool")
        loop.label(20, "random", seed=4)
    for loop.name in ("one", "two"):
        asked.append(loop.client.start_round(loop.project.id))
    for number in range(2):
        slices.after = {len(slices.seen) + 2: loop.worker.stopping.set}
        job = asked[number].job
        assert job is not None
        run_job(loop.worker, job)
        loop.worker.stopping.clear()
    assert len(checkpoints(loop)) == 2
    loop.drain(loop.another_worker())
    assert len(resumptions(loop)) == 1  # of project two
    loop.name = "one"
    assert len(resumptions(loop)) == 1
    assert weights(loop, asked[0]) == weights(loop, asked[1])
    assert checkpoints(loop) == []


def test_a_cancelled_round_stops_where_it_is(labeled: Loop, slices: Slices, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = labeled.client.start_round(labeled.project.id)

    def cancel() -> None:
        assert asked.job is not None
        labeled.cancel(asked.job)

    slices.after = {6: cancel}
    monkeypatch.setattr(Stage, "_look_up", _beating(Stage._look_up))
    labeled.drain()
    assert len(slices.seen) == 6
    done = labeled.client.round(asked.id)
    assert (done.status, list(done.models)) == ("cancelled", ["inverse_dynamics"])
    assert job_of(labeled).state == "cancelled"
    assert labeled.train().status == "current"


def _beating(look_up: Callable[..., None]) -> Callable[..., None]:
    """The heartbeat that comes by within two seconds comes now."""

    def beat_first(self: Stage, *rest: Any) -> None:
        self._job.beat()
        look_up(self, *rest)

    return beat_first


def test_a_cancelled_rounds_job_that_runs_again_does_nothing(labeled: Loop, slices: Slices) -> None:
    asked = labeled.client.start_round(labeled.project.id)
    assert asked.job is not None
    labeled.cancel(asked.job)
    labeled.requeue(asked.job)
    labeled.drain()
    assert slices.seen == []
    assert labeled.client.round(asked.id).status == "cancelled"


def ask_for_selection(loop: Loop) -> None:
    """A job of higher priority, as when a queue is drained."""
    with loop.worker.database.write() as session:
        scoring = session.scalars(select(ScoringRow)).one()
        payload = SelectQueue(scoring=scoring.id, length=600)
        jobs.enqueue(session, scoring.project_id, payload, scoring.id, loop.clock())


def test_a_round_lets_scoring_go_first(
    labeled: Loop, slices: Slices, undisturbed: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workers.job.time", SimpleNamespace(monotonic=lambda: 0.0))  # loading took no time
    asked = labeled.client.start_round(labeled.project.id)
    slices.after = {6: lambda: ask_for_selection(labeled)}
    run_next(labeled.worker)
    assert (job_of(labeled).state, job_of(labeled).error) == ("queued", None)
    labeled.drain()
    assert slices.seen == whole("inverse_dynamics") + whole("world_model")
    assert weights(labeled, asked) == base(undisturbed)


@pytest.mark.parametrize("other", ["network", "data"])
def test_a_checkpoint_of_another_network_or_of_other_data_starts_the_stage_anew(
    labeled: Loop, slices: Slices, undisturbed: dict[str, str], other: str
) -> None:
    """As after an upgrade between two attempts: what cannot be loaded shall not fail every attempt."""
    asked = interrupted(labeled, slices)
    kept = row_of(labeled).checkpoint_sha256
    assert kept is not None
    state = TrainingState.from_bytes(labeled.blobs.get("checkpoints", kept))
    if other == "network":
        name = next(name for name in state.tensors if name.startswith("model.") and state.tensors[name].dim() == 2)
        changed = {name: state.tensors[name][:-1].clone()}
    else:
        changed = {"order": state.tensors["order"][:-7].clone()}
    foreign = replace(state, tensors={**state.tensors, **changed})
    stored = labeled.blobs.put("checkpoints", foreign.to_bytes())
    labeled.set_row("job", job_of(labeled).id, checkpoint_sha256=stored)
    labeled.drain(labeled.another_worker())
    assert slices.seen[6:] == whole("world_model")
    assert resumptions(labeled) == []
    assert weights(labeled, asked) == base(undisturbed)


def test_a_job_that_is_always_out_of_memory_fails_and_the_queue_moves_on(labeled: Loop, slices: Slices) -> None:
    def out_of_memory() -> None:
        raise MemoryError

    first = labeled.client.start_round(labeled.project.id)
    slices.after = {1: out_of_memory, 2: out_of_memory, 3: out_of_memory}
    for _ in range(4):
        labeled.drain()
        labeled.clock.advance(100)
    failed = labeled.client.round(first.id)
    assert failed.status == "failed"
    assert "OutOfMemory: round 1, inverse_dynamics: out of memory. Lower ASIM_TRAINING_BYTES" in str(failed.error)
    assert job_of(labeled).attempts == 3
    assert labeled.train().status == "current"
