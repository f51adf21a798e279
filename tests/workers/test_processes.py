"""Worker processes that are killed: their job is not tried for ever, and nobody is left behind."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from uuid import UUID

from api_schemas.collections import CollectionCreate
from api_schemas.jobs import Job
from tests.loop.processes import eventually
from tests.workers.in_process import Loop

SECONDS = 30.0
HARD = 2_000_000  # transitions: more than there is time for


@contextmanager
def collector(loop: Loop, lease: str = "1") -> Iterator["subprocess.Popen[bytes]"]:
    """The embedded runner for collections, killed at the end."""
    argv = [sys.executable, "-m", "workers.runner", "--queues", "label"]
    environment = {**os.environ, "ASIM_DATA_FOLDER": str(loop.folder), "ASIM_JOB_LEASE_SECONDS": lease}
    process = subprocess.Popen(argv, env=environment, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait(SECONDS)


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
