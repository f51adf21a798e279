"""Worker processes that are killed: their job is not tried for ever, and nobody is left behind."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from uuid import UUID

import pytest

from api_schemas.collections import CollectionCreate
from api_schemas.jobs import Job
from tests.loop.processes import eventually
from tests.workers.in_process import Loop

SECONDS = 30.0
HARD = 2_000_000  # transitions: more than there is time for


HANGING = """
import ctypes, sys
from workers.runner import main
from workers.simulators.minigrid import MiniGridSimulator
hang, step, steps = ctypes.{library}(None).sleep, MiniGridSimulator.step, []
def hanging(simulator, action):
    steps.append(action)
    return hang(1000) if len(steps) > 300 else step(simulator, action)
MiniGridSimulator.step = hanging
sys.argv = ["runner", "--queues", "label"]
main()
"""


@contextmanager
def collector(
    loop: Loop, lease: str = "1", program: list[str] | None = None, **settings: str
) -> Iterator["subprocess.Popen[bytes]"]:
    """The embedded runner for collections, killed at the end."""
    argv = [sys.executable, *(program or ["-m", "workers.runner", "--queues", "label"])]
    environment = {**os.environ, "ASIM_DATA_FOLDER": str(loop.folder), "ASIM_JOB_LEASE_SECONDS": lease, **settings}
    process = subprocess.Popen(argv, env=environment, stderr=subprocess.PIPE if program else subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait(SECONDS)
        if process.stderr is not None:
            process.stderr.close()


def collect(loop: Loop, transitions: int) -> UUID:
    asked = CollectionCreate(project=loop.project.id, transitions=transitions, seed=1, split="pool")
    return loop.client.collect(asked).id


def job(loop: Loop, job_id: UUID) -> Job:
    return loop.client.job(job_id)


def test_a_job_that_kills_its_worker_every_time_fails_and_the_queue_moves_on(empty: Loop) -> None:
    """SIGKILL is what the kernel does to a process that takes too much memory."""
    hard, easy = collect(empty, HARD), collect(empty, 50)
    for attempt in (1, 2, 3):
        with collector(empty) as process:
            eventually(
                lambda: job(empty, hard).state == "running" and job(empty, hard).attempts == attempt,  # noqa: B023
                SECONDS,
                lambda: f"attempt {attempt} does not start: {job(empty, hard)}",  # noqa: B023
            )
            os.kill(process.pid, signal.SIGKILL)
    with collector(empty):
        eventually(lambda: job(empty, easy).state == "done", SECONDS, "the next job does not run")
        eventually(lambda: job(empty, hard).state == "failed", SECONDS, "the job is tried for ever")
    ended = job(empty, hard)
    assert ended.attempts == ended.max_attempts == 3
    assert "fell silent in attempt 3 of 3" in str(ended.error)


@pytest.mark.parametrize("library", ["PyDLL", "CDLL"], ids=["no thread runs any more", "other threads run"])
def test_a_hung_simulator_has_its_process_ended_and_another_goes_on(empty: Loop, library: str) -> None:
    """A call of PyDLL keeps Python's lock while it runs, as a simulator in an endless loop of C may."""
    hanging = ["-c", HANGING.format(library=library)]
    asked = collect(empty, 600)
    with collector(empty, "3", hanging, ASIM_SILENCE_SECONDS="3") as process:
        eventually(lambda: job(empty, asked).state == "running", SECONDS, "the job does not start")
        assert process.wait(SECONDS) == 1
        assert process.stderr is not None
        said = process.stderr.read().decode()
    assert "in hanging" in said
    with collector(empty):
        eventually(lambda: job(empty, asked).state == "done", SECONDS, lambda: f"nobody goes on: {job(empty, asked)}")
    assert empty.project.counts.pool_segments == 600


def test_a_cancelled_jobs_worker_stops_and_takes_the_next(empty: Loop) -> None:
    with collector(empty, "60"):
        hard = collect(empty, HARD)
        eventually(lambda: job(empty, hard).state == "running", SECONDS, "the job does not start")
        empty.cancel(hard)
        easy = collect(empty, 50)
        eventually(lambda: job(empty, easy).state == "done", SECONDS, "the worker is still at the cancelled job")
    assert job(empty, hard).state == "cancelled"


def test_an_orphan_ends_by_itself(empty: Loop) -> None:
    """The parent starts one that ends with it, and is killed."""
    child = "import os; from workers.orphans import end_with; end_with(os.getppid()); print(os.getpid(), flush=True); "
    hang = "import time; time.sleep(60)"
    start = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child + hang!r}])"
    parent = subprocess.Popen([sys.executable, "-c", start], stdout=subprocess.PIPE)
    assert parent.stdout is not None
    orphan = int(parent.stdout.readline())
    parent.kill()
    parent.wait(SECONDS)
    killed = time.monotonic()
    assert parent.stdout.read() == b""  # ends when the orphan does: nobody else holds the other end
    parent.stdout.close()
    assert time.monotonic() - killed < 20, f"the orphan {orphan} lives on"  # of the minute that it sleeps
