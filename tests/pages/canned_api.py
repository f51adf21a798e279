"""The real dashboard router beside an API that gives canned answers, on a real socket."""

import hashlib
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any, TypeVar
from uuid import UUID, uuid4

import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response
from numpy.typing import NDArray

from api_schemas.base import Page
from api_schemas.environments import Environment, Stream
from api_schemas.events import Event
from api_schemas.jobs import Job, JobState
from api_schemas.projects import Budget, LabelingPolicy, PoolCounts, Project
from api_schemas.rounds import (
    Diagnostics,
    GroupError,
    ModelError,
    ModelErrorCurve,
    ModelErrorPoint,
    OpenLoopError,
    Round,
    RoundStatus,
    Stage,
)
from api_schemas.trajectories import Trajectory
from service.dashboard.page import router
from service.store import npz

START = datetime(2026, 11, 22, 9, 0, tzinfo=UTC)
Item = TypeVar("Item")


@dataclass
class CannedApi:
    """What the API answers; tests change it while the page looks on. `key`: refuse requests without it."""

    projects: list[Project] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    jobs: list[Job] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    recordings: dict[str, tuple[UUID, dict[str, NDArray[Any]]]] = field(default_factory=dict)
    key: str | None = None
    requests: list[str] = field(default_factory=list)
    not_modified: int = 0

    def add_project(
        self, name: str, labeled: int = 0, held_out_labeled: int = 200, pool: int = 4000, budget: int | None = 500
    ) -> UUID:
        leased = 20 if labeled else 0
        remaining = None if budget is None else budget - labeled - leased
        project = Project(
            id=uuid4(), name=name, environment=Environment(simulator="minigrid"), family="grid", segment_length=1,
            stride=1, held_out_fraction=0.1, seed=0, policy=LabelingPolicy(label_budget=budget),
            counts=PoolCounts(
                pool_trajectories=pool // 100, pool_segments=pool, unlabeled=pool - labeled - leased, leased=leased,
                labeled=labeled, held_out_trajectories=pool // 1000, held_out_segments=pool // 10,
                held_out_labeled=held_out_labeled,
            ),
            budget=Budget(total=budget, spent=labeled, reserved=leased, remaining=remaining),
            label_watermark=labeled + held_out_labeled, current_round=None, created_at=START,
        )  # fmt: skip
        self.projects.append(project)
        return project.id

    def add_round(
        self,
        project: UUID,
        loss: float | None,
        status: RoundStatus = "current",
        warnings: list[str] | None = None,
        open_loop: list[OpenLoopError] | None = None,
    ) -> Round:
        own = [each for each in self.rounds if each.project == project]
        number = len(own) + 1
        done, over = status in ("current", "superseded"), status in ("current", "superseded", "failed", "cancelled")
        round_ = Round(
            id=uuid4(), project=project, number=number, watermark=100 * number, labels=100 * number, status=status,
            stages=[Stage(name="inverse_dynamics", seconds=14.2), Stage(name="world_model", seconds=48.75)], models={},
            model_error=None if loss is None else model_error(loss, open_loop),
            diagnostics=None if warnings is None else diagnostics(warnings), job=uuid4(),
            error="segment 3f at 12: loss is nan" if status == "failed" else None,
            created_at=START + timedelta(minutes=20 * number),
            finished_at=START + timedelta(minutes=20 * number + 4) if over else None,
        )  # fmt: skip
        self.rounds = [
            each.model_copy(update={"status": "superseded"})
            if each in own and done and each.status == "current"
            else each
            for each in self.rounds
        ] + [round_]
        if done:
            self.update_project(project, current_round=round_.id)
        return round_

    def update_project(self, project: UUID, **changes: object) -> None:
        self.projects = [each.model_copy(update=changes) if each.id == project else each for each in self.projects]

    def add_job(
        self, project: UUID, kind: str, state: JobState, progress: float, message: str = "", error: str | None = None
    ) -> Job:
        began = START + timedelta(minutes=len(self.jobs))
        job = Job(
            id=uuid4(), project=project, kind=kind, queue="train", state=state, attempts=0 if state == "queued" else 1,
            max_attempts=5, progress=progress, message=message, result={}, error=error, created_at=began,
            started_at=None if state == "queued" else began, heartbeat_at=None,
            finished_at=began + timedelta(minutes=1) if state in ("done", "failed", "cancelled") else None,
        )  # fmt: skip
        self.jobs.insert(0, job)
        return job

    def add_event(self, project: UUID, kind: str, data: dict[str, object], actor: str = "local") -> None:
        identity = len(self.events) + 1
        moment = START + timedelta(minutes=identity)
        by = {"actor": actor, "correlation": "canned"}
        self.events.append(Event(id=identity, project=project, kind=kind, data=data, created_at=moment, **by))

    def add_recording(self, project: UUID, arrays: dict[str, NDArray[Any]]) -> str:
        """A trajectory; its id, which no content decides here."""
        identity = f"{len(self.recordings):064x}"
        self.recordings[identity] = (project, arrays)
        self.add_event(project, "trajectory.added", {"trajectory": identity, "split": "pool"})
        return identity

    def curve(self, project: UUID) -> ModelErrorCurve:
        points = [
            ModelErrorPoint(
                round=each.id, number=each.number, labels=each.labels, model_error=each.model_error, created_at=START
            )
            for each in self.rounds
            if each.project == project and each.model_error is not None
        ]
        return ModelErrorCurve(project=project, points=points)


def model_error(loss: float, open_loop: list[OpenLoopError] | None = None) -> ModelError:
    """A model error with this loss, the rest made up from it; with open-loop errors, that of a robot."""
    groups = {
        name: GroupError(
            transitions=50, loss=loss * hard, dynamics_accuracy=1 - 0.1 * loss * hard, inverse_accuracy=0.9
        )
        for name, hard in (("movement", 0.6), ("interaction", 1.7))
    }
    figures = ModelError(transitions=200, loss=loss, dynamics_accuracy=1 - 0.1 * loss, inverse_accuracy=0.93)
    return figures.model_copy(update={"open_loop": open_loop} if open_loop else {"by_group": groups})


def diagnostics(warnings: list[str]) -> Diagnostics:
    """Diagnostics that say only this."""
    nothing = dict.fromkeys(("mask", "support", "aliasing", "back_action", "back_action_in_support", "ranking"))
    return Diagnostics.model_validate({**nothing, "sampled": 0, "actions": [], "warnings": warnings})


def trajectory(name: str, project: UUID, arrays: dict[str, NDArray[Any]]) -> Trajectory:
    """What the API says of a recording."""
    streams = {each: Stream.model_validate({"dtype": a.dtype.name, "shape": a.shape[1:]}) for each, a in arrays.items()}
    transitions = len(next(iter(arrays.values()))) - 1
    return Trajectory(
        id=name, project=project, split="pool", transitions=transitions, segments=transitions, labeled=0,
        streams=streams, bytes=1, has_provenance=False, created_at=START,
    )  # fmt: skip


def application(api: CannedApi) -> FastAPI:
    """The dashboard router over the canned answers."""
    app = FastAPI()
    app.include_router(router)

    def check(request: Request) -> None:
        api.requests.append(request.url.path)
        if api.key is not None and request.headers.get("authorization") != f"Bearer {api.key}":
            raise HTTPException(401, "Authorization: a key with the scope read is needed")

    def page(items: list[Item]) -> Page[Item]:
        return Page[Item](items=items)

    @app.get("/projects", response_model=Page[Project])
    def projects(request: Request) -> Page[Project]:
        check(request)
        return page(api.projects)

    @app.get("/projects/{project_id}", response_model=Project)
    def project(project_id: UUID, request: Request) -> Project:
        check(request)
        found = [each for each in api.projects if each.id == project_id]
        if not found:
            raise HTTPException(404, f"project: there is no project {project_id}.")
        return found[0]

    @app.get("/model-error")
    def curve(project: UUID, request: Request) -> Response:
        check(request)
        body = api.curve(project).model_dump_json()
        etag = f'"{hashlib.sha256(body.encode()).hexdigest()[:16]}"'
        if request.headers.get("if-none-match") == etag:
            api.not_modified += 1
            return Response(status_code=304, headers={"ETag": etag})
        return Response(body, media_type="application/json", headers={"ETag": etag})

    @app.get("/rounds", response_model=Page[Round])
    def rounds(project: UUID, request: Request) -> Page[Round]:
        check(request)
        return page([each for each in reversed(api.rounds) if each.project == project])

    @app.get("/jobs", response_model=Page[Job])
    def jobs(project: UUID, request: Request) -> Page[Job]:
        check(request)
        return page([each for each in api.jobs if each.project == project])

    @app.get("/trajectories", response_model=Page[Trajectory])
    def trajectories(project: UUID, request: Request, limit: int = 100) -> Page[Trajectory]:
        check(request)
        own = [trajectory(name, *each) for name, each in api.recordings.items() if each[0] == project]
        return page(own[:limit])

    @app.get("/trajectories/{name}", response_model=Trajectory)
    def one_trajectory(name: str, request: Request) -> Trajectory:
        check(request)
        if name not in api.recordings:
            raise HTTPException(404, f"trajectory: there is no trajectory {name}")
        return trajectory(name, *api.recordings[name])

    @app.get("/trajectories/{name}/content")
    def content(name: str, request: Request, start: int, length: int) -> Response:
        check(request)
        window = {each: array[start : start + length + 1] for each, array in api.recordings[name][1].items()}
        return Response(npz.dump(window), media_type="application/octet-stream")

    @app.get("/events", response_model=Page[Event])
    def events(project: UUID, request: Request, newest: bool = False, limit: int = 100) -> Page[Event]:
        check(request)
        own = [each for each in api.events if each.project == project]
        return Page[Event](items=(own[::-1] if newest else own)[:limit], next=None)

    return app


@contextmanager
def serving(app: FastAPI, port: int = 0) -> Iterator[int]:
    """Serve on loopback from a thread until the block ends; yields the port."""
    listener = socket.create_server(("127.0.0.1", port))
    config = uvicorn.Config(app, log_level="warning", ws="none", lifespan="off", timeout_graceful_shutdown=1)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    try:
        while not server.started:
            time.sleep(0.01)
        yield listener.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join(timeout=10)
        listener.close()
