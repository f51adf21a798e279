"""The service and one worker in this process, on one data folder: a client asks, `drain` does the jobs."""

from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import UUID

import httpx
import numpy as np
from starlette.testclient import TestClient

from api_schemas.acquisitions import Acquisition
from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.jobs import Job
from api_schemas.projects import Project, ProjectPatch
from api_schemas.rounds import Round
from asim.client import Client
from asim.errors import NotReady
from service.app import create_app
from service.clock import utc_now
from service.settings import Settings
from service.store.blobs import Blobs
from service.store.columns import Row
from workers.dispatch import open_worker, run_next
from workers.job import Worker
from workers.labeling import run_labeling

QUEUES = ("train", "score", "label", "default")
ADDRESS = "http://127.0.0.1"


class Clock:
    """The time of day, moved forward on demand."""

    def __init__(self) -> None:
        self.ahead = timedelta(0)

    def __call__(self) -> datetime:
        return utc_now() + self.ahead

    def advance(self, seconds: float) -> None:
        self.ahead += timedelta(seconds=seconds)


class InProcess(httpx.BaseTransport):
    """Carries the client's requests to an application in this process."""

    def __init__(self, http: TestClient) -> None:
        self._http = http

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        answer = self._http.request(
            request.method, str(request.url), headers=dict(request.headers), content=request.read()
        )
        return httpx.Response(answer.status_code, headers=dict(answer.headers), content=answer.content)


@dataclass
class Loop:
    """One data folder with an API and a worker on it."""

    settings: Settings
    clock: Clock = field(default_factory=Clock)
    name: str = "rooms"  # of the project that the methods are about

    def __post_init__(self) -> None:
        self._http = TestClient(create_app(self.settings, self.clock), base_url=ADDRESS, client=("127.0.0.1", 50000))
        self._http.__enter__()
        self.client = Client(ADDRESS, transport=InProcess(self._http))
        self.worker = self.another_worker()

    def close(self) -> None:
        """End both."""
        self.client.close()
        self.worker.database.close()
        self._http.__exit__(None, None, None)

    @property
    def project(self) -> Project:
        """The project as it stands."""
        return self.client.find_project(self.name)

    @property
    def blobs(self) -> Blobs:
        """The store of observations, weights and scores."""
        return self.worker.blobs

    @property
    def folder(self) -> Path:
        """The data folder."""
        return self.settings.data_folder

    def another_worker(self, settings: Settings | None = None, queues: tuple[str, ...] = QUEUES) -> Worker:
        """A worker of another owner on the same stores."""
        return open_worker(settings or self.settings, self.clock, queues)

    def drain(self, worker: Worker | None = None) -> int:
        """Run jobs until none waits; returns how many ran."""
        done = 0
        while run_next(worker or self.worker):
            done += 1
        return done

    def jobs(self, kind: str) -> list[Job]:
        """All jobs of a kind, oldest first."""
        return [job for job in self.client.jobs(self.project.id) if job.kind == kind][::-1]

    def collect(self, transitions: int | None = None, *, per_action: int = 0, **more: Any) -> Job:
        """Collect and wait; the job as it ended."""
        labels = CollectionLabels(per_action=per_action) if per_action else None
        asked = CollectionCreate(project=self.project.id, transitions=transitions, **{"labels": labels, **more})
        job = self.client.collect(asked)
        self.drain()
        return self.client.job(job.id)

    def acquire(self, count: int, strategy: str | None = None, **more: Any) -> Acquisition:
        """Acquire, and do the jobs that a ranked queue takes."""
        try:
            return self.client.acquire(self.project.id, count, strategy=strategy, wait=0, **more)
        except NotReady:
            self.drain()
            return self.client.acquire(self.project.id, count, strategy=strategy, wait=0, **more)

    def ask_for_queue(self, strategy: str) -> None:
        """Have a job queued that ranks the pool by a strategy that has no queue yet."""
        with suppress(NotReady):
            self.client.acquire(self.project.id, 1, strategy=strategy, wait=0)
            raise AssertionError(f"{strategy} has a ranked queue already")

    def label(self, count: int, strategy: str | None = None, seed: int = 0) -> Acquisition:
        """Acquire a batch and have the simulator label it."""
        batch = self.acquire(count, strategy)
        run_labeling(self.client, batch, np.random.default_rng(seed))
        return batch

    def train(self) -> Round:
        """A round on all labels, to its end."""
        asked = self.client.start_round(self.project.id)
        self.drain()
        return self.client.round(asked.id)

    def change(self, **fields: Any) -> None:
        """Change the labeling policy."""
        self.client.change_project(self.project.id, ProjectPatch(**fields))

    def cancel(self, job: UUID) -> None:
        """DELETE /jobs/{id}."""
        answer = self._http.delete(f"/jobs/{job}")
        assert (answer.status_code, answer.json()["state"]) == (200, "cancelled"), answer.text

    def requeue(self, job: UUID) -> None:
        """Put a job back, as after a crash between its last write and its completion."""
        self.set_row("job", job, state="queued", owner=None, lease_until=None, finished_at=None)

    def set_row(self, table: str, key: object, **values: object) -> None:
        """Write columns of a row behind the service's back."""
        columns = Row.metadata.tables[table]
        with self.worker.database.write() as session:
            session.execute(columns.update().where(columns.c.id == key).values(**values))


def segments_of(batch: Acquisition) -> list[tuple[str, int]]:
    """(trajectory, start) of a batch, by rank."""
    return [(item.trajectory, item.start) for item in batch.items]
