"""A job while it runs: when it gives way to others, and when it counts as hung."""

import time
from dataclasses import replace
from types import SimpleNamespace
from uuid import uuid4

import pytest
from structlog.testing import capture_logs

from api_schemas.jobs import TrainRound
from service import jobs
from service.jobs import JobLost
from tests.service.kit import Served
from tests.service.test_canaries import plant
from tests.service.test_jobs import LEASE, claimed, enqueue, generator, reap
from workers.job import RunningJob


def test_no_job_gives_way_to_a_canary(served: Served) -> None:
    project = served.project()
    enqueue(served, project, generator(project))
    running = RunningJob(served.worker("train"), claimed(served))
    running.prepared()
    time.sleep(0.01)
    plant(served)
    assert not running.should_give_way()
    enqueue(served, project, TrainRound(round=uuid4(), strategy="cycle"))
    assert running.should_give_way()


def test_a_job_works_for_as_long_as_it_took_to_get_ready_before_it_gives_way(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    project, seconds = served.project(), [100.0]
    monkeypatch.setattr("workers.job.time", SimpleNamespace(monotonic=lambda: seconds[0]))
    enqueue(served, project, generator(project))
    worker = served.worker("train")
    running = RunningJob(worker, claimed(served))
    enqueue(served, project, TrainRound(round=uuid4(), strategy="cycle"))
    seconds[0] += 30
    assert not running.should_give_way()  # it is still loading
    running.prepared()
    seconds[0] += 29
    running.prepared()  # by the next stage
    assert not running.should_give_way()
    seconds[0] += 1
    assert running.should_give_way()
    seconds[0] -= 30
    worker.stopping.set()  # the process ends: that waits for nothing
    assert running.should_give_way()
    worker.stopping.clear()


def test_a_job_that_has_said_nothing_for_long_is_not_renewed_and_goes_to_another(
    on_both: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    project, seconds = on_both.project(), [100.0]
    monkeypatch.setattr("workers.job.time", SimpleNamespace(monotonic=lambda: seconds[0]))
    worker = on_both.worker("train")
    bounded = replace(worker, settings=worker.settings.model_copy(update={"silence_seconds": 60.0}))
    job = enqueue(on_both, project, generator(project))
    with on_both.services.database.write() as session:
        row = jobs.claim(session, job, worker.owner, on_both.clock(), LEASE)
        assert row is not None
        running = RunningJob(bounded, jobs.lease_of(row))
    with capture_logs() as said:
        for step in (running.go_on, lambda: running.report(0.5, "step 1"), lambda: _write(running)):
            seconds[0] += 61
            step()  # it was slow, and is not hung
            on_both.clock.advance(LEASE - 1)
            running.beat()
            reap(on_both)
            assert on_both.get(f"/jobs/{job}")["state"] == "running"
        seconds[0] += 61
        on_both.clock.advance(LEASE - 1)
        running.beat()
        on_both.clock.advance(2)
        running.beat()
        reap(on_both)
    assert on_both.get(f"/jobs/{job}")["state"] == "queued"
    hangs = [(line["job"], line["last"]) for line in said if line["event"] == "job_hangs"]
    assert hangs == [(str(job), "step 1")]
    with pytest.raises(JobLost):
        _write(running)


def _write(running: RunningJob) -> None:
    with running.transaction():
        pass
