"""Scaled-out mode: the API with a key, jobs carried by a real Celery worker (prefork, spawn) over Redis."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from redis import Redis

from api_schemas.jobs import Job
from api_schemas.keys import KeyCreate
from api_schemas.projects import Project
from asim.client import Client
from asim.errors import Forbidden
from service import keys
from service.clock import utc_now
from service.store.database import Database, migrate, open_database
from service.store.tables import JobRow
from tests.loop.first_round import JOB_SECONDS, START_SECONDS, collected, first_round
from tests.loop.invariants import check_invariants, retries
from tests.loop.processes import command_of, eventually, started, stop
from tests.servers import RedisSpace
from workers.labeling import run_labeling

QUEUES = ("train", "score", "label", "default")
API = "uvicorn service.app:create_app --factory --port 0"
WORKER = "celery -A workers.app worker -c 1 --loglevel INFO"


@dataclass
class Scaled:
    """An API and a Celery worker, each a process of its own, on one data folder."""

    folder: Path
    url: str
    client: Client
    database: Database
    space: RedisSpace
    keys_before: set[str]
    worker: "subprocess.Popen[bytes]"

    def owner_of(self, job: Job) -> int:
        """The process that runs the job; 0 while none does."""
        with self.database.read() as session:
            owner = session.get_one(JobRow, job.id).owner
        return int(owner.split(":")[1]) if owner else 0


@pytest.fixture
def scaled(tmp_path: Path, redis_space: RedisSpace) -> Iterator[Scaled]:
    folder, before = tmp_path / "data", _keys(redis_space)
    folder.mkdir()
    url = f"sqlite:///{folder / 'asim.db'}"
    migrate(url)
    database = open_database(url)
    with database.write() as session:
        key = keys.create(session, KeyCreate(name="test", scopes=["admin"]), utc_now()).secret
    settings = {
        "ASIM_DATA_FOLDER": str(folder),
        "ASIM_BROKER_URL": redis_space.url,
        "ASIM_CELERY_PREFIX": redis_space.prefix,
        "ASIM_JOB_LEASE_SECONDS": "3",
    }
    api = started([sys.executable, "-m", *API.split()], settings, folder / "api.log")
    queues = ",".join(f"{redis_space.prefix}.{name}" for name in QUEUES)
    worker = started([sys.executable, "-m", *WORKER.split(), "-Q", queues], settings, folder / "celery.log")
    try:
        address = _address(folder / "api.log")
        with Client(address, key) as client:
            yield Scaled(folder, address, client, database, redis_space, before, worker)
    finally:
        stop(worker)
        stop(api)
        database.close()
        sys.stdout.write((folder / "celery.log").read_text()[-5000:] + (folder / "api.log").read_text()[-3000:])


def test_the_loop_runs_through_a_celery_worker(scaled: Scaled) -> None:
    client, generator = scaled.client, np.random.default_rng(0)
    with pytest.raises(Forbidden), Client(scaled.url) as stranger:
        list(stranger.projects())
    project = collected(client, 1500)
    eventually(lambda: client.health().status == "ok", START_SECONDS, "no worker is alive")
    first, acknowledged = first_round(client, project, generator)
    batch = client.acquire(project.id, 20, wait=JOB_SECONDS)
    assert (batch.strategy, batch.round) == ("confident_cycle", first.id)
    accepted = run_labeling(client, batch, generator)
    acknowledged += [(receipt.trajectory, receipt.start) for receipt in accepted.receipts]

    second = client.start_round(project.id)
    assert second.job is not None
    job = client.job(second.job)
    eventually(lambda: client.round(second.id).stages != [], JOB_SECONDS, "no stage is done")
    child = scaled.owner_of(job)
    assert "spawn" in command_of(child)
    os.kill(child, signal.SIGKILL)
    done = client.wait_for_round(second.id, timeout=JOB_SECONDS)
    assert (done.status, client.round(first.id).status) == ("current", "superseded")
    assert retries(client, second.job) == 1
    assert [len(point.model_error.by_group) for point in client.model_error(project.id).points] == [2, 2]
    check_invariants(client, scaled.folder, acknowledged)
    _stops_in_the_middle_of_a_job(scaled, project)
    _check_keys(scaled)


def _stops_in_the_middle_of_a_job(scaled: Scaled, project: Project) -> None:
    """A warm shutdown does not wait for the subgoal generator, which has minutes to go."""
    (job,) = [job for job in scaled.client.jobs(project.id) if job.kind == "train_subgoal_generator"]
    eventually(lambda: scaled.client.job(job.id).state == "running", START_SECONDS, "the last job does not start")
    child = scaled.owner_of(job)
    scaled.worker.terminate()
    assert scaled.worker.wait(15) == 0
    assert command_of(child) == ""
    given_back = scaled.client.job(job.id)
    assert (given_back.state, given_back.attempts, given_back.error) == ("queued", 0, None)


def _check_keys(scaled: Scaled) -> None:
    """All that Celery keeps in Redis stands under the prefix, so that projects may share a server."""
    new = _keys(scaled.space) - scaled.keys_before
    assert any(name.startswith(f"{scaled.space.prefix}:_kombu.binding.") for name in new)
    foreign = [name for name in new if not name.startswith(scaled.space.prefix)]
    strays = [name for name in foreign if re.match("_kombu|unacked|celery", name) or scaled.space.prefix in name]
    assert strays == []


def _keys(space: RedisSpace) -> set[str]:
    with Redis.from_url(space.url) as server:
        return {name.decode(errors="replace") for name in server.scan_iter("*")}


def _address(log: Path) -> str:
    """Where uvicorn says that it listens."""
    found: list[str] = []

    def told() -> bool:
        found.extend(re.findall(r"http://127\.0\.0\.1:\d+", log.read_text()))
        return bool(found)

    eventually(told, START_SECONDS, lambda: f"uvicorn does not listen: {log.read_text()[-3000:]}")
    return found[0]
