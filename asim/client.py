"""The SDK: one method an endpoint, typed answers, refusals as exceptions."""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Self, TypeVar
from uuid import UUID, uuid4

import httpx
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, TypeAdapter

from api_schemas.acquisitions import (
    AcquireRequest,
    Acquisition,
    AcquisitionPending,
    ExtendRequest,
    Mode,
    Purpose,
    ReleaseRequest,
)
from api_schemas.base import Page
from api_schemas.collections import CollectionCreate
from api_schemas.errors import Problem
from api_schemas.events import Event
from api_schemas.jobs import Job
from api_schemas.keys import Health, KeyCreate, KeyCreated
from api_schemas.labels import Label, LabelsAccepted, LabelsRequest
from api_schemas.models import ModelVersion
from api_schemas.projects import Project, ProjectCreate, ProjectPatch
from api_schemas.rounds import ModelErrorCurve, Round, RoundCreate
from api_schemas.strategies import Strategy
from api_schemas.trajectories import SplitChoice, TrajectoriesAdded, Trajectory
from asim.arrays import Arrays, pack, unpack
from asim.errors import JobCancelled, JobFailed, NotFound, NotReady, RoundCancelled, RoundFailed
from asim.transport import IDEMPOTENCY_KEY, Transport

Item = TypeVar("Item")
Schema = TypeVar("Schema", bound=BaseModel)
Id = UUID | str
POLL_SECONDS = 0.2
PAGE_SIZE = 1000  # the largest that the service gives
LONGEST_HOLD = 20.0  # seconds that the service is asked to hold back an answer
FOLLOW_SECONDS, FOLLOW_PAGE = 1.0, 100  # while events are followed: the last page is asked for again and again


class Client:
    """Speaks to one service. Use it as a context manager, or call `close`.

    Args:
        base_url: where the service listens, as `asim serve` prints it.
        key: an API key; embedded mode needs none.
        timeout: seconds without a byte after which a request counts as lost.
        transport: an httpx transport, for tests.
        retries: how often a request is sent again: a GET, `acquire` and `label`, which carry an Idempotency-Key, and
            whatever found no connection.

    Every method raises asim.errors.ServiceError (or its subclass for the status) where the service refuses, and
    asim.errors.Unreachable where no answer comes.
    """

    def __init__(
        self,
        base_url: str,
        key: str | None = None,
        timeout: float = 60.0,
        transport: httpx.BaseTransport | None = None,
        *,
        retries: int = 5,
    ) -> None:
        self.base_url = base_url.rstrip("/")
        self._transport = Transport(self.base_url, key, timeout, transport, retries=retries)
        self._hold = min(LONGEST_HOLD, timeout / 2)  # an answer that is held back must not count as lost

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._transport.close()

    # Projects

    def create_project(self, project: ProjectCreate) -> Project:
        """POST /projects."""
        return self._post("/projects", project, Project)

    def projects(self) -> Iterator[Project]:
        """GET /projects, all pages."""
        return self._pages("/projects", Project)

    def project(self, project: Id) -> Project:
        """GET /projects/{id}."""
        return self._get(f"/projects/{project}", Project)

    def find_project(self, name: str) -> Project:
        """The project of that name, or of that id. Raises NotFound."""
        for project in self.projects():
            if name in (project.name, str(project.id)):
                return project
        detail = f"no project is named {name!r} or has that id"
        raise NotFound(
            Problem(type="urn:asim:error:unknown-project", title="Unknown project", status=404, detail=detail)
        )

    def change_project(self, project: Id, patch: ProjectPatch) -> Project:
        """PATCH /projects/{id}: the fields that `patch` sets."""
        answer = self._transport.request("PATCH", f"/projects/{project}", body=patch)
        return Project.model_validate_json(answer.content)

    # Trajectories

    def add_trajectories(
        self, project: Id, files: Mapping[str, Mapping[str, NDArray[np.generic]]], split: SplitChoice = "auto"
    ) -> TrajectoriesAdded:
        """POST /trajectories: by file name, arrays by stream name, time first, T + 1 rows."""
        return self.add_files(project, {name: pack(arrays) for name, arrays in files.items()}, split)

    def add_files(self, project: Id, files: Mapping[str, bytes], split: SplitChoice = "auto") -> TrajectoriesAdded:
        """POST /trajectories with npz files as they are."""
        uploads = [("files", (name, content, "application/octet-stream")) for name, content in files.items()]
        params = {"project": project, "split": split}
        answer = self._transport.request("POST", "/trajectories", params=params, files=uploads)
        return TrajectoriesAdded.model_validate_json(answer.content)

    def trajectories(self, project: Id) -> Iterator[Trajectory]:
        """GET /trajectories, all pages."""
        return self._pages("/trajectories", Trajectory, project=project)

    def trajectory(self, project: Id, trajectory: str) -> Trajectory:
        """GET /trajectories/{id}."""
        return self._get(f"/trajectories/{trajectory}", Trajectory, project=project)

    def trajectory_content(
        self, project: Id, trajectory: str, start: int | None = None, length: int | None = None
    ) -> Arrays:
        """Observations `start` to `start + length`: `length` + 1 rows a stream. By default the whole trajectory."""
        path = f"/trajectories/{trajectory}/content"
        return unpack(self._bytes(path, project=project, start=start, length=length))

    def provenance(
        self, project: Id, trajectory: str, start: int | None = None, length: int | None = None
    ) -> tuple[Arrays, dict[str, object]]:
        """Simulator states of the same rows, and how they came about: simulator, options, behavior, seed."""
        path = f"/trajectories/{trajectory}/provenance"
        states = unpack(self._bytes(path, project=project, start=start, length=length))
        return states, json.loads(str(states.pop("__metadata__")))

    def collect(self, collection: CollectionCreate) -> Job:
        """POST /collections: the job that runs the behavior."""
        return self._post("/collections", collection, Job)

    # Acquisitions and labels

    def acquire(
        self,
        project: Id,
        count: int,
        *,
        mode: Mode = "pool",
        strategy: str | None = None,
        purpose: Purpose = "pool",
        lease_seconds: float | None = None,
        labeler: str = "",
        wait: float = 60.0,
        idempotency_key: str | None = None,
    ) -> Acquisition:
        """POST /acquire, for at most `wait` seconds: where the queue is not ranked yet, its job is awaited.

        idempotency_key: the same key gives the same batch, also where an answer was lost; by default one a call.

        Raises:
            NotReady: there was still no ranked queue after `wait` seconds.
            JobFailed: the job that ranks it failed, or was cancelled.
        """
        request = AcquireRequest(
            project=UUID(str(project)),
            count=count,
            mode=mode,
            strategy=strategy,
            purpose=purpose,
            lease_seconds=lease_seconds,
            labeler=labeler,
        )
        return self._acquired(request, idempotency_key or str(uuid4()), wait)

    def acquisition(self, acquisition: Id) -> Acquisition:
        """GET /acquisitions/{id}; its token is not told again."""
        return self._get(f"/acquisitions/{acquisition}", Acquisition)

    def extend(self, acquisition: Id, token: int, lease_seconds: float | None = None) -> Acquisition:
        """POST /acquisitions/{id}/extend: the lease ends `lease_seconds` from now."""
        return self._post(
            f"/acquisitions/{acquisition}/extend", ExtendRequest(token=token, lease_seconds=lease_seconds), Acquisition
        )

    def release(self, acquisition: Id, token: int) -> Acquisition:
        """POST /acquisitions/{id}/release: give back what is not labeled yet."""
        return self._post(f"/acquisitions/{acquisition}/release", ReleaseRequest(token=token), Acquisition)

    def label(self, labels: LabelsRequest, *, idempotency_key: str | None = None) -> LabelsAccepted:
        """POST /labels: all of them, or none. The same key gives the same receipts; by default one a call."""
        headers = {IDEMPOTENCY_KEY: idempotency_key or str(uuid4())}
        answer = self._transport.request("POST", "/labels", body=labels, headers=headers)
        return LabelsAccepted.model_validate_json(answer.content)

    def labels(self, project: Id) -> Iterator[Label]:
        """GET /labels, all pages."""
        return self._pages("/labels", Label, project=project)

    # Rounds, models, model error

    def start_round(self, project: Id) -> Round:
        """POST /rounds: retrain on all labels that are there now."""
        return self._post("/rounds", RoundCreate(project=UUID(str(project))), Round)

    def round(self, round: Id) -> Round:  # noqa: A002  (the word of the API)
        """GET /rounds/{id}."""
        return self._get(f"/rounds/{round}", Round)

    def rounds(self, project: Id) -> Iterator[Round]:
        """GET /rounds, all pages."""
        return self._pages("/rounds", Round, project=project)

    def wait_for_round(
        self,
        round: Id,  # noqa: A002
        timeout: float | None = None,
        progress: Callable[[Round], None] | None = None,
    ) -> Round:
        """Poll until the round is current or superseded.

        Raises RoundFailed, also for one that was cancelled, or NotReady after `timeout` seconds.
        """

        def done(seen: Round) -> bool:
            if progress is not None:
                progress(seen)
            if seen.status in ("failed", "cancelled"):
                raise RoundCancelled(seen) if seen.status == "cancelled" else RoundFailed(seen)
            return seen.status in ("current", "superseded")

        return _poll(lambda: self.round(round), done, timeout, f"round {round}")

    def models(self, project: Id) -> Iterator[ModelVersion]:
        """GET /models, all pages."""
        return self._pages("/models", ModelVersion, project=project)

    def model(self, model: Id) -> ModelVersion:
        """GET /models/{id}."""
        return self._get(f"/models/{model}", ModelVersion)

    def weights(self, model: Id) -> bytes:
        """GET /models/{id}/weights: a safetensors file."""
        return self._bytes(f"/models/{model}/weights")

    def model_error(self, project: Id) -> ModelErrorCurve:
        """GET /model-error: the learning curve, oldest round first."""
        return self._get("/model-error", ModelErrorCurve, project=project)

    # Jobs, events and the rest

    def job(self, job: Id) -> Job:
        """GET /jobs/{id}."""
        return self._get(f"/jobs/{job}", Job)

    def jobs(self, project: Id) -> Iterator[Job]:
        """GET /jobs, newest first, all pages."""
        return self._pages("/jobs", Job, project=project)

    def wait_for_job(self, job: Id, timeout: float | None = None, progress: Callable[[Job], None] | None = None) -> Job:
        """Poll until the job is done.

        Raises JobFailed, also for one that was cancelled, or NotReady after `timeout` seconds.
        """

        def done(seen: Job) -> bool:
            if progress is not None:
                progress(seen)
            return _is_done(seen)

        return _poll(lambda: self.job(job), done, timeout, f"job {job}")

    def cancel_job(self, job: Id) -> Job:
        """DELETE /jobs/{id}: it is not run any more. Raises Conflict where it is done or has failed."""
        return Job.model_validate_json(self._transport.request("DELETE", f"/jobs/{job}").content)

    def events(self, project: Id | None = None, cursor: str | None = None) -> Iterator[Event]:
        """GET /events from `cursor` on, oldest first, until there are no more for now."""
        return self._pages("/events", Event, project=project, cursor=cursor)

    def follow_events(self, project: Id | None = None) -> Iterator[Event]:
        """GET /events, oldest first and each once; then those that come, for ever."""
        cursor, last = None, 0
        while True:
            page = self._page("/events", Event, project=project, cursor=cursor, limit=FOLLOW_PAGE)
            for event in page.items:
                if event.id > last:
                    last = event.id
                    yield event
            if page.next is None:  # the last page says no cursor: it is read again until it is full
                time.sleep(FOLLOW_SECONDS)
            else:
                cursor = page.next

    def strategies(self) -> list[Strategy]:
        """GET /strategies."""
        answer = self._transport.request("GET", "/strategies")
        return TypeAdapter(list[Strategy]).validate_json(answer.content)

    def create_key(self, key: KeyCreate) -> KeyCreated:
        """POST /keys; the secret is told this once."""
        return self._post("/keys", key, KeyCreated)

    def delete_key(self, key: Id) -> None:
        """DELETE /keys/{id}."""
        self._transport.request("DELETE", f"/keys/{key}")

    def health(self) -> Health:
        """GET /health/ready, also where it answers 503."""
        answer = self._transport.request("GET", "/health/ready", accept=(503,))
        return Health.model_validate_json(answer.content)

    # How they are asked

    def _acquired(self, request: AcquireRequest, key: str, wait: float) -> Acquisition:
        """Ask under one key until there is a batch: of an answer that is not ready the service keeps nothing.

        The first answer is not held back: it names the job, so that its failure is seen.
        """
        deadline, awaited, headers = time.monotonic() + wait, None, {IDEMPOTENCY_KEY: key}
        while True:
            left = deadline - time.monotonic()
            hold = 0 if awaited is None else max(0, int(min(left, self._hold)))
            preferred = {"Prefer": f"wait={hold}"} if hold else {}
            answer = self._transport.request("POST", "/acquire", body=request, headers=headers | preferred)
            if answer.status_code != 202:
                return Acquisition.model_validate_json(answer.content)
            pending = AcquisitionPending.model_validate_json(answer.content)
            if awaited is not None:
                _is_done(self.job(awaited))
            if left <= 0:
                raise NotReady(f"{pending.detail} (waited {wait:g} s for job {pending.job})")
            if awaited is not None and "Preference-Applied" not in answer.headers:
                time.sleep(min(POLL_SECONDS, max(0.0, deadline - time.monotonic())))
            awaited = pending.job

    def _get(self, path: str, schema: type[Schema], **params: object) -> Schema:
        return schema.model_validate_json(self._transport.request("GET", path, params=params).content)

    def _post(self, path: str, body: BaseModel, schema: type[Schema]) -> Schema:
        return schema.model_validate_json(self._transport.request("POST", path, body=body).content)

    def _bytes(self, path: str, **params: object) -> bytes:
        return self._transport.request("GET", path, params=params).content

    def _pages(self, path: str, schema: type[Schema], **params: object) -> Iterator[Schema]:
        while True:
            page = self._page(path, schema, limit=PAGE_SIZE, **params)
            yield from page.items
            if page.next is None or not page.items:
                return
            params["cursor"] = page.next

    def _page(self, path: str, schema: type[Schema], **params: object) -> Page[Schema]:
        page_of = Page[schema]  # type: ignore[valid-type]  # pydantic builds the page's class at run time
        page: Page[Schema] = page_of.model_validate_json(self._bytes(path, **params))
        return page


def _is_done(job: Job) -> bool:
    """Raises JobFailed for a job that will never be."""
    if job.state in ("failed", "cancelled"):
        raise JobCancelled(job) if job.state == "cancelled" else JobFailed(job)
    return job.state == "done"


def _poll(ask: Callable[[], Item], done: Callable[[Item], bool], timeout: float | None, what: str) -> Item:
    deadline = None if timeout is None else time.monotonic() + timeout
    while True:
        seen = ask()
        if done(seen):
            return seen
        if deadline is not None and time.monotonic() >= deadline:
            raise NotReady(f"{what} was not done after {timeout:g} s")
        time.sleep(POLL_SECONDS)
