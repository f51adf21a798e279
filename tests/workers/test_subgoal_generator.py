"""The subgoal generator's job: action-free, always behind other work, and no step of it is lost or done differently."""

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import torch

from api_schemas.jobs import Job
from models.segments import SegmentBatch
from models.training import TrainingState, advance
from tests.workers.conftest import STEPS, OpenLoop
from tests.workers.in_process import Loop
from workers import stage, trainer, training
from workers.dispatch import run_next

SLICE = stage.FIRST_STEPS


class Slices:
    """Watches the generator's slices, of SLICE steps each: what they were given; something may happen after one."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.batches: list[SegmentBatch] = []
        self.steps: list[int] = []
        self.after: dict[int, Any] = {}
        patch.setattr(trainer, "advance", self._advance)
        patch.setattr(stage, "_next_steps", lambda *_: SLICE)

    def _advance(
        self, network: Any, batch: SegmentBatch, state: TrainingState, until: int, **more: Any
    ) -> TrainingState:
        trained = advance(network, batch, state, until, **more)
        if network.kind != "subgoal_generator":
            return trained
        self.batches.append(batch)
        self.steps.append(state.step)
        self.after.pop(len(self.steps), lambda: None)()
        return trained


@pytest.fixture
def slices(monkeypatch: pytest.MonkeyPatch) -> Slices:
    return Slices(monkeypatch)


@pytest.fixture
def waiting(labeled: Loop) -> Loop:
    """A project whose round is done and whose subgoal generator is next."""
    asked = labeled.client.start_round(labeled.project.id)
    while labeled.client.round(asked.id).status != "current":
        run_next(labeled.worker)
    assert subgoal_job(labeled).state == "queued"
    return labeled


def subgoal_job(loop: Loop) -> Job:
    """The only job of its kind."""
    (job,) = loop.jobs("train_subgoal_generator")
    return job


def weights(loop: Loop) -> str:
    """Hash of the subgoal generator's weights."""
    (model,) = (model for model in loop.client.models(loop.project.id) if model.kind == "subgoal_generator")
    return model.sha256


def test_it_comes_after_all_other_work(trained: Loop) -> None:
    finished = {job.kind: job.finished_at for job in trained.client.jobs(trained.project.id)}
    last = finished.pop("train_subgoal_generator")
    assert last is not None
    assert all(end is not None and end < last for end in finished.values())


def test_it_sees_the_whole_pool_and_no_action(waiting: Loop, slices: Slices) -> None:
    waiting.drain()
    assert waiting.project.counts.labeled == 60
    assert len(slices.batches) == STEPS // SLICE
    for batch in slices.batches:
        assert batch.actions is None
        assert batch.action_sets is None
        assert batch.size == waiting.project.counts.pool_segments == 600


def test_its_weights_do_not_depend_on_the_labels(opened: OpenLoop, labeled_folder: Path, trained_folder: Path) -> None:
    loop = opened(labeled_folder)
    loop.label(30, "random", seed=5)
    loop.train()
    assert weights(loop) == weights(opened(trained_folder))


def test_it_gives_way_and_ends_with_the_same_bits(waiting: Loop, slices: Slices, undisturbed: dict[str, str]) -> None:
    waiting.worker = waiting.another_worker(waiting.settings.model_copy(update={"checkpoint_seconds": 1e-9}))
    slices.after = {2: lambda: waiting.ask_for_queue("vanilla_cycle")}
    run_next(waiting.worker)
    job = subgoal_job(waiting)
    assert (job.state, job.attempts, job.error) == ("queued", 0, None)
    assert len(slices.steps) == 2
    waiting.drain()
    assert slices.steps == list(range(0, STEPS, SLICE))  # no step was done twice
    assert subgoal_job(waiting).attempts == 1
    assert weights(waiting) == undisturbed["subgoal_generator"]


def test_a_stopping_worker_loses_no_slice(waiting: Loop, slices: Slices, undisturbed: dict[str, str]) -> None:
    slices.after = {2: waiting.worker.stopping.set}
    run_next(waiting.worker)
    assert (subgoal_job(waiting).state, subgoal_job(waiting).attempts) == ("queued", 0)
    waiting.drain(waiting.another_worker())
    assert slices.steps == list(range(0, STEPS, SLICE))
    assert weights(waiting) == undisturbed["subgoal_generator"]


def test_after_a_crash_it_resumes_from_the_last_checkpoint(
    waiting: Loop, slices: Slices, undisturbed: dict[str, str]
) -> None:
    def crash() -> None:
        raise OSError(5, "Input/output error")

    waiting.worker = waiting.another_worker(waiting.settings.model_copy(update={"checkpoint_seconds": 1e-9}))
    slices.after = {3: crash}
    waiting.drain()
    waiting.clock.advance(10)
    waiting.drain()
    assert slices.steps == [0, 5, 10, 10, 15]
    assert weights(waiting) == undisturbed["subgoal_generator"]


def test_a_pool_that_grows_meanwhile_changes_nothing(
    waiting: Loop, slices: Slices, undisturbed: dict[str, str]
) -> None:
    slices.after = {2: waiting.worker.stopping.set}
    run_next(waiting.worker)
    waiting.worker = waiting.another_worker()
    waiting.collect(300, seed=77, split="pool")
    assert subgoal_job(waiting).state == "done"
    assert {batch.size for batch in slices.batches} == {600}
    assert weights(waiting) == undisturbed["subgoal_generator"]


@pytest.mark.parametrize("off", [-3600.0, 3600.0])
def test_its_pool_does_not_depend_on_the_clocks_of_the_machines(
    waiting: Loop, slices: Slices, undisturbed: dict[str, str], off: float
) -> None:
    """Members and job were written by machines whose clocks are an hour apart."""
    waiting.clock.advance(off)
    waiting.collect(300, seed=77, split="pool")  # runs in front of the generator, whose job is queued already
    assert subgoal_job(waiting).state == "done"
    assert {batch.size for batch in slices.batches} == {600}
    assert weights(waiting) == undisturbed["subgoal_generator"]


@pytest.mark.parametrize("off", [-3600.0, 3600.0])
def test_an_attempt_that_ended_before_its_job_was_done_is_not_repeated(
    trained: Loop, slices: Slices, off: float
) -> None:
    before = weights(trained)
    (model,) = (model for model in trained.client.models(trained.project.id) if model.kind == "subgoal_generator")
    trained.set_row("model_version", model.id, created_at=model.created_at + timedelta(seconds=off))
    trained.requeue(subgoal_job(trained).id)
    trained.drain()
    assert slices.steps == []
    assert subgoal_job(trained).result == {"model": str(model.id)}
    assert weights(trained) == before


def test_an_older_jobs_payload_means_the_whole_pool(waiting: Loop, slices: Slices) -> None:
    older = {"kind": "train_subgoal_generator", "project": str(waiting.project.id)}
    waiting.set_row("job", subgoal_job(waiting).id, payload=older)
    waiting.drain()
    assert {batch.size for batch in slices.batches} == {600}
    assert subgoal_job(waiting).state == "done"


def test_it_follows_the_growth_of_the_pool_and_not_the_labels(trained: Loop) -> None:
    trained.label(5)
    trained.train()
    subgoal_job(trained)  # there is still one only
    trained.collect(2500, seed=78, split="pool")
    trained.label(5)
    trained.train()
    assert len(trained.jobs("train_subgoal_generator")) == 2


def test_a_large_pool_is_thinned_out_evenly(waiting: Loop, slices: Slices, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "ACTION_FREE_SEGMENTS", 200)
    waiting.drain()
    starts = torch.tensor([segment.start for segment in slices.batches[0].segments])
    assert 200 <= len(starts) < 300
    assert bool((starts % 3 == 0).all())
