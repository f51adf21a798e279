"""The subgoal generator's job: action-free, always behind other work, and no step of it is lost or done differently."""

from pathlib import Path
from typing import Any

import pytest
import torch

from api_schemas.jobs import Job
from models.segments import SegmentBatch
from models.training import TrainingState, advance
from tests.workers.conftest import STEPS, OpenLoop
from tests.workers.in_process import Loop
from workers import stage, training
from workers.dispatch import run_next

SLICE = stage.FIRST_STEPS


class Slices:
    """Watches the generator's slices, of SLICE steps each: what they were given; something may happen after one."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.batches: list[SegmentBatch] = []
        self.steps: list[int] = []
        self.after: dict[int, Any] = {}
        patch.setattr(stage, "advance", self._advance)
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


def test_it_follows_the_growth_of_the_pool_and_not_the_labels(trained: Loop) -> None:
    trained.label(5)
    trained.train()
    subgoal_job(trained)  # there is still one only
    trained.collect(2500, seed=78, split="pool")
    trained.label(5)
    trained.train()
    assert len(trained.jobs("train_subgoal_generator")) == 2


def test_a_large_pool_is_thinned_out_evenly(waiting: Loop, slices: Slices, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "SUBGOAL_SEGMENTS", 200)
    waiting.drain()
    starts = torch.tensor([segment.start for segment in slices.batches[0].segments])
    assert 200 <= len(starts) < 300
    assert bool((starts % 3 == 0).all())
