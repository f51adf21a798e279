"""A scaled-out service under test: an API, Celery workers, PostgreSQL and Redis, every one of which may be killed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from uuid import UUID

import httpx
from sqlalchemy import select

from api_schemas.rounds import Round
from asim.client import Client
from service.clock import utc_now
from service.store.database import open_database
from service.store.tables import JobRow
from tests.loop.invariants import Acknowledged, check_invariants
from tests.loop.processes import command_of, environment, eventually, free_port
from tests.loop.rows import Segment, check_rows, labels_of, segments_of, snapshot
from tests.private_servers import PrivateRedis

SCIENCE = "train,score,default"
START_SECONDS = 60.0
ROUND_SECONDS = 150.0
SETTINGS = {
    "ASIM_JOB_LEASE_SECONDS": "1.5",
    "ASIM_CHECKPOINT_SECONDS": "0.4",
    "ASIM_RESEND_SECONDS": "1.5",
    "ASIM_CANARY_SECONDS": "8",
    "ASIM_QUEUE_LENGTH": "400",
    "ASIM_POLL_SECONDS": "0.1",
}


class Deployed:
    """A process of the deployment that is killed and started again; its output is appended to one log."""

    def __init__(self, name: str, argv: list[str], settings: Mapping[str, str], folder: Path) -> None:
        self.name, self.argv, self.settings = name, argv, dict(settings)
        self.log = folder / f"{name}.log"
        self.process: subprocess.Popen[bytes] | None = None
        self.starts = 0

    @property
    def pid(self) -> int:
        """Of the process that was started last."""
        assert self.process is not None
        return self.process.pid

    @property
    def alive(self) -> bool:
        """True while it runs."""
        return self.process is not None and self.process.poll() is None

    def start(self) -> None:
        """Start it, without waiting."""
        self.starts += 1
        with self.log.open("ab") as log:
            own = environment(**self.settings)
            self.process = subprocess.Popen(self.argv, env=own, stdout=log, stderr=log, process_group=0)

    def end(self, number: signal.Signals, seconds: float = 30.0) -> int:
        """Signal it and wait; the exit status."""
        assert self.process is not None
        self.process.send_signal(number)
        return self.process.wait(seconds)

    def children(self) -> list[int]:
        """Processes that it has started and that live."""
        return children_of(self.pid)

    def said(self) -> str:
        """Its log."""
        return self.log.read_text(errors="replace")


class Deployment:
    """Processes on one data folder, one database and one Redis, and a client with an admin key."""

    def __init__(self, folder: Path, database_url: str, redis: PrivateRedis, key: str, **settings: str) -> None:
        self.folder, self.database_url, self.redis, self.key = folder, database_url, redis, key
        self.settings = {
            **SETTINGS,
            "ASIM_DATA_FOLDER": str(folder),
            "ASIM_DATABASE_URL": database_url,
            "ASIM_BROKER_URL": redis.url,
            **settings,
        }
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        argv = ["uvicorn", "service.app:create_app", "--factory", "--port", str(self.port), "--log-level", "warning"]
        self.api = Deployed("api", [sys.executable, "-m", *argv], self.settings, folder)
        self.workers: list[Deployed] = []
        self.database = open_database(database_url)
        self.client = Client(self.url, key, timeout=30.0)

    def start_api(self) -> None:
        """Start the API and wait until it answers."""
        self.api.start()
        eventually(self._listens, START_SECONDS, lambda: f"the API does not answer: {self.api.said()[-3000:]}")

    def start_worker(self, queues: str = SCIENCE, **settings: str) -> Deployed:
        """Start a prefork worker of one child, as `asim worker` runs it."""
        argv = [sys.executable, "-m", "asim", "worker", "--queues", queues]
        return self._start_worker(argv, settings)

    def start_solo_worker(self, queues: str = SCIENCE, **settings: str) -> Deployed:
        """Start a worker that does the jobs in its only process."""
        names = ",".join(f"asim.{name}" for name in queues.split(","))
        argv = ["celery", "--app", "workers.app", "worker", "--queues", names, "--pool", "solo", "--loglevel", "INFO"]
        return self._start_worker([sys.executable, "-m", *argv], {"ASIM_PROVENANCE_URL": "", **settings})

    def revive(self) -> None:
        """What a supervisor does: start the workers that have ended."""
        for worker in self.workers:
            if not worker.alive:
                worker.start()

    def await_workers(self, seconds: float = START_SECONDS) -> None:
        """Wait until every worker consumes, and canaries of what they serve have come through."""
        began = time.time()
        eventually(
            lambda: (
                all(worker.said().count(" ready.") >= worker.starts for worker in self.workers)
                and self.canaries_since(began) >= {"train", "score"}
            ),
            seconds,
            lambda: f"workers are not ready: {self.last_words()}",
        )

    def job(self, job_id: UUID) -> JobRow:
        """The job's row as it is now."""
        with self.database.read() as session:
            return session.get_one(JobRow, job_id)

    def holder_of(self, job_id: UUID) -> int:
        """Process that holds a live lease on the job; 0 while none does."""
        row = self.job(job_id)
        live = row.state == "running" and row.lease_until is not None and row.lease_until > utc_now()
        return int(row.owner.split(":")[1]) if live and row.owner else 0

    def await_holder(self, job_id: UUID, seconds: float = START_SECONDS, *, fence: int = 0) -> int:
        """Wait until a living process holds the job, under a fence of more than `fence`, or it is over (0)."""
        found = [0]

        def held() -> bool:
            row = self.job(job_id)
            if row.state in ("done", "failed", "cancelled"):
                return True
            found[0] = self.holder_of(job_id)
            return row.fence > fence and bool(command_of(found[0]))

        eventually(held, seconds, lambda: f"nobody holds {job_id}: {self.last_words()}")
        return found[0]

    def await_round(self, asked: Round, seconds: float = ROUND_SECONDS) -> Round:
        """Wait until the round is in use."""
        done = self.client.wait_for_round(asked.id, timeout=seconds)
        assert done.status in ("current", "superseded"), done.error
        return done

    def await_rest(self, seconds: float = 60.0) -> None:
        """Wait until no job of a project is open."""
        eventually(lambda: self.open_jobs() == [], seconds, lambda: f"open: {self.open_jobs()}; {self.last_words()}")

    def open_jobs(self) -> list[str]:
        """Kind and state of the jobs of projects that are queued or running."""
        with self.database.read() as session:
            rows = session.scalars(select(JobRow).where(JobRow.state.in_(("queued", "running"))))
            return [f"{row.kind} {row.state}" for row in rows if row.project_id is not None]

    def canaries_since(self, moment: float) -> set[str]:
        """Queues whose canary was done after `moment`, in seconds since the epoch."""
        with self.database.read() as session:
            rows = session.scalars(select(JobRow).where(JobRow.kind == "canary", JobRow.finished_at.is_not(None)))
            return {row.queue for row in rows if row.finished_at and row.finished_at.timestamp() > moment}

    def check_rows(self) -> None:
        """The cheap invariants, at any moment."""
        with snapshot(self.database_url) as session:
            check_rows(session)

    def check(self, acknowledged: Acknowledged, ended: list[UUID] | None = None) -> None:
        """All invariants, at rest."""
        check_invariants(
            self.client, self.folder, acknowledged, database_url=self.database_url, exact=True, ended=ended or []
        )

    def lost_or_doubled(self, acknowledged: Mapping[UUID, Iterable[Segment]]) -> int:
        """Labels that were acknowledged and are not there, and labels that are there twice."""
        with self.database.read() as session:
            found = {project: segments_of(labels_of(session, project)) for project in acknowledged}
        lost = sum(len(set(told) - set(found[project])) for project, told in acknowledged.items())
        return lost + sum(count - 1 for labels in found.values() for count in labels.values())

    def last_words(self) -> str:
        """The ends of all logs."""
        return "\n".join(
            f"--- {each.name}\n{each.said()[-2500:]}" for each in (self.api, *self.workers) if each.process
        )

    def close(self) -> None:
        """Kill everything that runs on the data folder, orphans too."""
        self.client.close()
        self.database.close()
        eventually(lambda: self._kill_all() == 0, 10, "processes that do not end")
        for each in (self.api, *self.workers):
            if each.process is not None:
                each.process.wait(10)

    def _start_worker(self, argv: list[str], settings: Mapping[str, str]) -> Deployed:
        name = f"worker-{len(self.workers) + 1}"
        worker = Deployed(name, argv, {**self.settings, **settings}, self.folder)
        self.workers.append(worker)
        worker.start()
        return worker

    def _listens(self) -> bool:
        assert self.api.alive, self.api.said()[-3000:]
        try:
            return httpx.get(f"{self.url}/health/live", timeout=5).is_success
        except httpx.TransportError:
            return False

    def _kill_all(self) -> int:
        """SIGKILL to every process that was given this data folder; how many there were."""
        mark = f"ASIM_DATA_FOLDER={self.folder}".encode()
        found = [pid for pid in _pids() if mark in _environment_of(pid) and _state_of(pid) != "Z"]
        for pid in found:
            kill(pid, signal.SIGKILL)
        return len(found)


def kill(pid: int, number: signal.Signals) -> bool:
    """Signal a process; False where it is gone."""
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


def children_of(parent: int) -> list[int]:
    """Processes that it has started and that live."""
    return [pid for pid in _pids() if _parent_of(pid) == parent and command_of(pid)]


def _pids() -> list[int]:
    return [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]


def _environment_of(pid: int) -> list[bytes]:
    try:
        return Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:  # gone, or another user's
        return []


def _stat_of(pid: int) -> list[str]:
    """State, parent and so on: what follows the name in parentheses."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return ["", "0"]


def _state_of(pid: int) -> str:
    return _stat_of(pid)[0]


def _parent_of(pid: int) -> int:
    return int(_stat_of(pid)[1])
