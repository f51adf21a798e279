"""A broker that is killed and comes back empty costs a running job nothing."""

import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from uuid import UUID

import pytest

from service.carrier import Relay
from tests.loop.processes import eventually, started, stop
from tests.private_servers import PrivateRedis
from tests.workers.in_process import Loop
from tests.workers.test_processes import HARD, collect, job

SECONDS, LEASE = 60.0, 2.0
WORKER = "celery -A workers.app worker -c 1 --loglevel INFO -Q asim.label"


@pytest.fixture
def redis() -> Iterator[PrivateRedis]:
    with PrivateRedis() as server:
        yield server


@pytest.fixture
def log(empty: Loop, redis: PrivateRedis) -> Iterator[Path]:
    """Output of a Celery worker for collections, whose jobs a relay sends."""
    path = empty.folder / "celery.log"
    settings = {
        "ASIM_DATA_FOLDER": str(empty.folder),
        "ASIM_BROKER_URL": redis.url,
        "ASIM_JOB_LEASE_SECONDS": str(LEASE),
    }
    worker = started([sys.executable, "-m", *WORKER.split()], settings, path)
    relay = Relay(empty.worker.database, empty.settings.model_copy(update={"broker_url": redis.url}), empty.clock)
    relay.start()
    yield path
    relay.stop()
    stop(worker)


def running(loop: Loop, job_id: UUID) -> bool:
    return job(loop, job_id).state == "running"


def test_a_running_job_goes_on_while_the_broker_restarts(empty: Loop, redis: PrivateRedis, log: Path) -> None:
    hard = collect(empty, HARD)
    eventually(lambda: running(empty, hard), SECONDS, lambda: f"the job does not start: {log.read_text()[-3000:]}")
    redis.end(signal.SIGKILL)
    time.sleep(LEASE)
    redis.start()
    eventually(lambda: log.read_text().count("Connected to redis") >= 2, SECONDS, lambda: log.read_text()[-3000:])
    time.sleep(2 * LEASE)  # had it been ended, its lease would be over, and the next attempt begun
    assert (job(empty, hard).state, job(empty, hard).attempts) == ("running", 1), log.read_text()[-3000:]
    empty.cancel(hard)
    easy = collect(empty, 50)
    eventually(lambda: job(empty, easy).state == "done", SECONDS, lambda: f"no next job: {log.read_text()[-3000:]}")
