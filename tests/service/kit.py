"""A service under test: the app, a worker in the same process, a clock that both read; rooms and robots to feed it."""

import io
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID, uuid4

import numpy as np
from anyio.from_thread import start_blocking_portal
from fastapi import FastAPI
from fastapi.testclient import TestClient
from httpx2 import Response
from numpy.typing import NDArray

from api_schemas.errors import PROBLEM_JSON, Problem
from api_schemas.policies import PolicyCreate
from service import policies
from service.api.dependencies import Services
from service.app import create_app
from service.settings import Settings
from workers.dispatch import open_worker, run_next
from workers.job import Worker

Arrays = dict[str, NDArray[Any]]
Json = dict[str, Any]
ROOM: Json = {"simulator": "minigrid"}
ROBOT: Json = {
    "spaces": {
        "observations": {
            "front": {"dtype": "uint8", "shape": (64, 64, 3)},
            "wrist": {"dtype": "uint8", "shape": (64, 64, 3)},
            "proprioception": {"dtype": "float32", "shape": (9,)},
        },
        "actions": {"kind": "box", "shape": (7,), "low": -1.0, "high": 1.0},
    }
}


OPERATIONS: list[tuple[str, re.Pattern[str], Json]] = []  # as the first service describes them: all describe the same
MAX_BODY_BYTES = 4 * 2**20
START = datetime(2026, 1, 1, tzinfo=UTC)


class Clock:
    """Stands still but for a microsecond a reading, until it is told to advance."""

    def __init__(self) -> None:
        self.now = START
        self._lock = threading.Lock()

    def __call__(self) -> datetime:
        with self._lock:
            self.now += timedelta(microseconds=1)
            return self.now

    def advance(self, seconds: float) -> None:
        with self._lock:
            self.now += timedelta(seconds=seconds)


@dataclass
class Served:
    """One service and the calls that tests make of it."""

    settings: Settings
    clock: Clock
    app: FastAPI
    client: TestClient
    opened: ExitStack
    workers: dict[tuple[str, ...], Worker] = field(default_factory=dict)

    @property
    def services(self) -> Services:
        held: Services = self.app.state.services
        return held

    def worker(self, *queues: str) -> Worker:
        """A worker of these queues, opened once."""
        if queues not in self.workers:
            self.workers[queues] = open_worker(self.settings, self.clock, queues)
        return self.workers[queues]

    def drain(self, *queues: str) -> int:
        """Run the jobs that wait in the queues, and those that they ask for; returns how many ran."""
        ran = 0
        while run_next(self.worker(*(queues or ("score",)))):
            ran += 1
        return ran

    def project(self, **fields: Any) -> str:
        """A new project in which every trajectory is in the pool and no round starts by itself."""
        policy = {"round_labels": 0} | fields.pop("policy", {})
        defaults = {"name": uuid4().hex, "environment": ROOM, "held_out_fraction": 0.0}
        answer = self.client.post("/projects", json=defaults | fields | {"policy": policy})
        assert answer.status_code == 201, answer.text
        return str(answer.json()["id"])

    def show(self, project: str) -> Json:
        """The project as it stands."""
        return self.get(f"/projects/{project}")

    def get(self, path: str, **query: Any) -> Json:
        """JSON of a page that must be there."""
        answer = self.client.get(path, params=query)
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    def send(self, project: str, files: Sequence[tuple[str, bytes]], **query: Any) -> Response:
        """Upload raw files."""
        return self.client.post(
            "/trajectories", params={"project": project} | query, files=[("files", file) for file in files]
        )

    def upload(self, project: str, *trajectories: Mapping[str, NDArray[Any]], **query: Any) -> list[Json]:
        """Receipts of the trajectories."""
        files = [(f"{number}.npz", npz(arrays)) for number, arrays in enumerate(trajectories)]
        answer = self.send(project, files, **query)
        assert answer.status_code == 201, answer.text
        return list(answer.json()["items"])

    def policy(self, project: str, weights: bytes, state: bytes | None = None) -> str:
        """The id of a new policy of the project, of a training that goes on from a state if one is given."""
        store = self.services.provenance
        assert store is not None
        left = None if state is None else store.put("trainings", state)
        stage = policies.Stage(store.put("policies", weights), len(weights), left, 0, 10, 0.5, 2)
        with self.services.database.write() as session:
            policies.keep(session, uuid4(), PolicyCreate(project=UUID(project)), stage, self.clock())
        return stage.sha256

    def ask(self, project: str, count: int = 1, **fields: Any) -> Response:
        """POST /acquire as it answers."""
        return self.client.post("/acquire", json={"project": project, "count": count} | fields)

    def acquire(self, project: str, count: int = 1, **fields: Any) -> Json:
        """A batch, after the scoring and the longer selection that it may have to wait for."""
        answer = self.ask(project, count, **fields)
        for _ in range(2):
            if answer.status_code != 202:
                break
            self.drain()
            answer = self.ask(project, count, **fields)
        assert answer.status_code == 201, answer.text
        return dict(answer.json())

    def label(self, project: str, items: Sequence[Json], batch: Json | None = None, **fields: Any) -> Response:
        """POST /labels, under the batch's lease where one is given."""
        lease = {} if batch is None else {"acquisition": batch["id"], "token": batch["token"]}
        return self.client.post("/labels", json={"project": project, "items": list(items)} | lease | fields)

    def another_client(self) -> TestClient:
        """A client for a thread of its own."""
        return client_of(self.app)

    def events(self, project: str) -> list[Json]:
        """All events of a project; on PostgreSQL the last are shown once no older transaction is open on the server."""
        newest = self.get("/events", project=project, newest=True, limit=1)["items"][0]["id"]
        items: list[Json] = self.events_up_to(project, newest, limit=1000)["items"]
        return items

    def events_up_to(self, project: str, last: int, **query: Any) -> Json:
        """A page of a project's events, once it lists that one: other tests on the server have transactions, too."""
        deadline = time.monotonic() + 20
        while True:
            page = self.get("/events", project=project, **query)
            if last in [item["id"] for item in page["items"]]:
                return page
            assert time.monotonic() < deadline, f"event {last} is not listed"
            time.sleep(0.02)

    def close(self) -> None:
        """Give back all connections."""
        self.client.close()
        self.opened.close()
        self.services.database.close()
        for worker in self.workers.values():
            worker.database.close()


def serve(settings: Settings, clock: Clock | None = None) -> Served:
    """The service on these settings."""
    clock = clock or Clock()
    app = create_app(settings, clock)
    client, opened = client_of(app), ExitStack()
    client.portal = opened.enter_context(start_blocking_portal())  # one event loop, not a new one a request
    return Served(settings, clock, app, client, opened)


def client_of(app: FastAPI) -> TestClient:
    """A client on this machine that takes no answer which the service's own description does not name."""
    client = TestClient(app, base_url="http://127.0.0.1", client=("127.0.0.1", 50000))
    client.event_hooks = {"response": [documented(app)]}
    return client


def documented(app: FastAPI) -> Callable[[Any], None]:
    """Fails on an answer to one of the described endpoints whose status is not described."""
    if not OPERATIONS:
        OPERATIONS.extend(
            (method.upper(), re.compile(re.sub(r"\{[^}]+\}", "[^/]+", path) + "$"), operation["responses"])
            for path, methods in app.openapi()["paths"].items()
            for method, operation in methods.items()
        )

    def check(answer: Any) -> None:
        method, path, status = answer.request.method, answer.request.url.path, str(answer.status_code)
        for known, pattern, answers in OPERATIONS:
            if known == method and pattern.match(path):
                assert status in answers or status == "500", (
                    f"{method} {path} answered {status}, described are {sorted(answers)}"
                )

    return check


def room(seed: int, transitions: int = 5, size: int = 6) -> Arrays:
    """A trajectory in the MiniGrid code; its cells are drawn by chance, which no part of the service minds."""
    rng = np.random.default_rng(seed)
    grid = rng.integers(0, (11, 6, 5), (transitions + 1, size, size, 3)).astype(np.uint8)
    return {"grid": grid, "carried": rng.integers(0, (11, 6, 5), (transitions + 1, 3)).astype(np.uint8)}


def robot(seed: int, transitions: int = 11) -> Arrays:
    """A trajectory of two cameras and proprioception."""
    rng = np.random.default_rng(seed)
    cameras = {name: rng.integers(0, 256, (transitions + 1, 64, 64, 3), np.uint8) for name in ("front", "wrist")}
    return cameras | {"proprioception": rng.normal(size=(transitions + 1, 9)).astype(np.float32)}


def npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """The arrays as a file."""
    buffer = io.BytesIO()
    np.savez(buffer, **dict(arrays))
    return buffer.getvalue()


def unpack(data: bytes) -> Arrays:
    """The arrays of a file."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def answers(batch: Json, action: Any = 0) -> list[Json]:
    """The same action for every step of every item of a batch."""
    return [
        {"trajectory": item["trajectory"], "start": item["start"], "actions": [action] * item["length"]}
        for item in batch["items"]
    ]


def segments(batch: Json) -> list[tuple[str, int]]:
    """What a batch offers, in order."""
    return [(item["trajectory"], item["start"]) for item in batch["items"]]


def refused(answer: Response, status: int, kind: str, *words: object) -> Json:
    """The problem that a refusal answers with, checked: whole, of this kind, its sentence with these words."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == PROBLEM_JSON
    problem = Problem.model_validate(answer.json())
    assert problem.type == f"urn:asim:error:{kind}", answer.text
    assert problem.status == status
    assert problem.title
    assert not problem.title.endswith(".")
    for word in words:
        assert str(word) in problem.detail, problem.detail
    return dict(answer.json())


def same(found: Mapping[str, NDArray[Any]], expected: Mapping[str, NDArray[Any]]) -> bool:
    """Equal names, dtypes, shapes and bytes."""
    return sorted(found) == sorted(expected) and all(
        found[name].dtype == array.dtype
        and found[name].shape == array.shape
        and found[name].tobytes() == np.ascontiguousarray(array).tobytes()
        for name, array in expected.items()
    )


UNKNOWN = str(UUID(int=4711))
