"""A job while it runs: its lease, its transactions, its heartbeat."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from types import TracebackType
from typing import Self

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service import jobs
from service.jobs import JobLost
from service.log import get_logger
from service.settings import Settings
from service.store.blobs import Blobs
from service.store.database import Database
from service.store.queries import jobs as queries
from workers.watchdog import Watchdog

log = get_logger("worker")
GRACE = 5.0  # seconds from where a job counts as hung, which is told, to the end of its process


class GaveWay(Exception):
    """The job stops here and is queued again: its process ends, or work of higher priority waits."""


@dataclass(frozen=True)
class Worker:
    """What a worker process holds open. It has no way to simulator states or provenance."""

    settings: Settings
    database: Database
    blobs: Blobs
    clock: Callable[[], datetime]
    owner: str
    queues: tuple[str, ...]
    stopping: threading.Event = field(default_factory=threading.Event)
    watchdog: Watchdog = field(default_factory=lambda: Watchdog(armed=False))


class RunningJob:
    """One attempt at a job. Its writes go through `transaction`, which refuses them once the lease is lost."""

    def __init__(self, worker: Worker, lease: jobs.Lease) -> None:
        self.worker, self.lease = worker, lease
        self._progress, self._message = 0.0, ""
        self._lost = threading.Event()
        self._began = self._heard = time.monotonic()
        self._ready: float | None = None
        self._told_of_silence = False

    @contextmanager
    def transaction(self) -> Iterator[Session]:
        """A write transaction under this attempt's fence. Raises JobLost."""
        with self.worker.database.write() as session:
            jobs.held(session, self.lease)
            yield session
        self._heard = time.monotonic()

    def now(self) -> datetime:
        """The worker's clock."""
        return self.worker.clock()

    def report(self, progress: float, message: str) -> None:
        """Say how far the job is; the heartbeat writes it. Raises JobLost, and GaveWay when the process ends."""
        self._progress, self._message = progress, message
        self.go_on()

    def go_on(self) -> None:
        """Say that the job is at work still, where there is no more to report; from any thread.

        A job that neither reports nor says this for `silence_seconds` counts as hung, and its process is ended: call it
        once for each blob, chunk or slice, whatever one of them may take. Raises JobLost, and GaveWay when the process
        ends.
        """
        self._heard = time.monotonic()
        if self._lost.is_set():
            raise JobLost(self.lease.job_id, self.lease.fence)
        if self.worker.stopping.is_set():
            raise GaveWay(f"worker {self.worker.owner} stops")

    def prepared(self) -> None:
        """All that it works on is loaded: from here on it brings its subject further. The first call counts."""
        self._ready = self._ready or time.monotonic()

    def should_give_way(self) -> bool:
        """True where the process ends or a job of higher priority waits for this worker.

        Before it gives way to others an attempt works for as long as it took to get ready, so that however many of them
        keep coming at most half of its time goes to loading.
        """
        if self.worker.stopping.is_set():
            return True
        if self._ready is None or time.monotonic() - self._ready < self._ready - self._began:
            return False
        with self.worker.database.read() as session:
            return queries.higher_waiting(session, self.worker.queues, self.lease.priority, self.now())

    def watch(self) -> None:
        """From what was heard last, the job has `silence_seconds` to say something, else its process is ended."""
        left = self._heard + self.worker.settings.silence_seconds - time.monotonic()
        self.worker.watchdog.wait(max(0.0, left) + GRACE)

    def beat(self) -> None:
        """Renew the lease once, and say that this worker is there: a Celery child has nobody else to say it.

        A job that hangs is not renewed: its lease ends, the reaper gives it to another, and its process ends.
        """
        if self._hangs():
            return
        self.watch()
        worker, seconds = self.worker, self.worker.settings.job_lease_seconds
        try:
            with worker.database.write() as session:
                jobs.heartbeat(session, self.lease, self.now, seconds, self._progress, self._message)
                jobs.worker_alive(session, worker.owner, worker.queues, self.now())
        except JobLost:
            self._lost.set()
        except SQLAlchemyError as error:  # the next beat tries again; the lease outlasts a few of them
            log.warning("heartbeat_failed", job=str(self.lease.job_id), error=str(error))

    def _hangs(self) -> bool:
        silence = time.monotonic() - self._heard
        if silence < self.worker.settings.silence_seconds:
            self._told_of_silence = False
            return False
        if not self._told_of_silence:
            log.warning("job_hangs", job=str(self.lease.job_id), silent_for=round(silence), last=self._message)
        self._told_of_silence = True
        return True


class Heartbeat:
    """Beats a job's heart from a thread, three times a lease, while the block runs."""

    def __init__(self, job: RunningJob) -> None:
        self._job = job
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def __enter__(self) -> Self:
        self._job.watch()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        self._thread.join()
        self._job.worker.watchdog.rest()

    def _run(self) -> None:
        while not self._done.wait(min(2.0, self._job.worker.settings.job_lease_seconds / 3)):
            self._job.beat()
