"""The embedded carrier outlives whatever its database does, and one chore that fails keeps no other from being done."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from sqlalchemy.exc import InterfaceError, InternalError, SQLAlchemyError
from sqlalchemy.orm import Session

from service import jobs, reaper
from tests.loop.processes import eventually
from tests.workers.in_process import Loop
from workers import runner
from workers.job import Heartbeat, RunningJob, Worker

CLOSED = InterfaceError("SELECT 1", {}, Exception("the connection is closed"))
IDLE = InternalError("SELECT 1", {}, Exception("terminating connection due to idle-in-transaction timeout"))


def breaks(patch: pytest.MonkeyPatch, owner: object, name: str, error: Exception, times: int | None) -> list[int]:
    """The first `times` calls (None: every call) raise; returns the numbers of the calls."""
    real: Callable[..., Any] = getattr(owner, name)
    calls: list[int] = []

    def broken(*args: Any, **more: Any) -> Any:
        calls.append(len(calls) + 1)
        if times is None or len(calls) <= times:
            raise error
        return real(*args, **more)

    patch.setattr(owner, name, broken)
    return calls


@pytest.fixture
def worker(labeled: Loop) -> Worker:
    return labeled.another_worker()


@contextmanager
def running(worker: Worker) -> Iterator[threading.Thread]:
    """The runner's loop in a thread, until the block ends."""
    thread = threading.Thread(target=runner.run, args=(worker,), daemon=True)
    thread.start()
    try:
        yield thread
    finally:
        worker.stopping.set()
        thread.join(20)
        assert not thread.is_alive()


@pytest.mark.parametrize("error", [CLOSED, IDLE], ids=lambda error: type(error).__name__)
def test_a_database_that_drops_a_connection_ends_neither_the_runner_nor_its_sign_of_life(
    labeled: Loop, worker: Worker, monkeypatch: pytest.MonkeyPatch, error: SQLAlchemyError
) -> None:
    monkeypatch.setattr(runner, "ALIVE_SECONDS", 0.05)
    claims = breaks(monkeypatch, runner, "run_next", error, 1)
    signs = breaks(monkeypatch, jobs, "worker_alive", error, 2)
    with running(worker) as thread:
        eventually(lambda: len(claims) > 2 and len(signs) > 4, 20, lambda: f"{claims} claims, {signs} signs of life")
        assert thread.is_alive()
        assert any(each.name == "alive" and each.is_alive() for each in threading.enumerate())


def test_a_reaper_that_fails_keeps_no_job_from_being_run(
    labeled: Loop, worker: Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = breaks(monkeypatch, reaper, "reap", CLOSED, None)
    asked = labeled.client.start_round(labeled.project.id)
    with running(worker):
        eventually(lambda: labeled.client.round(asked.id).status == "current", 60, "the round does not run")
    assert tries


def test_a_heartbeat_that_fails_is_tried_again(labeled: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    labeled.client.start_round(labeled.project.id)
    quick = labeled.another_worker(labeled.settings.model_copy(update={"job_lease_seconds": 0.3}))
    with quick.database.write() as session:
        lease = _claimed(session, quick)
    beats = breaks(monkeypatch, jobs, "heartbeat", CLOSED, 2)
    with Heartbeat(RunningJob(quick, lease)):
        eventually(lambda: len(beats) > 3, 20, "the heart has stopped")
    quick.database.close()


def _claimed(session: Session, worker: Worker) -> jobs.Lease:
    row = jobs.claim_next(session, ("train",), worker.owner, worker.clock(), 60.0)
    assert row is not None
    return jobs.lease_of(row)
