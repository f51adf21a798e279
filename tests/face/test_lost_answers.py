"""The client against the real service, over a wire that loses answers after the service has committed."""

import shutil
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from uuid import UUID

import httpx
import numpy as np
import pytest
from starlette.testclient import TestClient

from api_schemas.environments import DiscreteActions, Environment, Spaces, Stream
from api_schemas.labels import LabelItem, LabelsRequest
from api_schemas.projects import LabelingPolicy, ProjectCreate
from asim.client import Client
from asim.errors import Invalid, NotReady, Unreachable
from service.app import create_app
from service.clock import utc_now
from service.settings import Settings
from tests.workers.in_process import ADDRESS, InProcess
from workers.dispatch import open_worker, run_next

SPACES = Spaces(
    observations={"joints": Stream(dtype="float32", shape=(3,))}, actions=DiscreteActions(n=4)
)  # no family takes them: nothing is trained
QUEUES = ("train", "score", "label", "default")


class LossyWire(httpx.BaseTransport):
    """Hands requests to the service; loses the next `losses` answers to writes."""

    def __init__(self, service: httpx.BaseTransport) -> None:
        self._service = service
        self.losses = 0
        self.answers: list[httpx.Response] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        answer = self._service.handle_request(request)
        if request.method != "POST":
            return answer
        self.answers.append(answer)
        if self.losses:
            self.losses -= 1
            raise httpx.ReadError("the connection broke before the answer came")
        return answer


@pytest.fixture
def settings(tmp_path: Path, migrated: Path) -> Settings:
    shutil.copy(migrated, tmp_path / "asim.db")
    return Settings(data_folder=tmp_path)


@pytest.fixture
def wire(settings: Settings) -> Iterator[LossyWire]:
    with TestClient(create_app(settings), base_url=ADDRESS, client=("127.0.0.1", 50000)) as http:
        yield LossyWire(InProcess(http))


@pytest.fixture
def client(wire: LossyWire, monkeypatch: pytest.MonkeyPatch) -> Client:
    monkeypatch.setattr("asim.transport.LONGEST_PAUSE", 0.0)
    return Client(ADDRESS, transport=wire)


@pytest.fixture
def unranked(client: Client) -> UUID:
    """Twelve segments in the pool, and no queue yet."""
    policy = LabelingPolicy(strategy="random", round_labels=0)
    environment = Environment(spaces=SPACES)
    created = client.create_project(ProjectCreate(name="arm", environment=environment, policy=policy)).id
    joints = np.random.default_rng(0).normal(size=(13, 3)).astype(np.float32)
    client.add_trajectories(created, {"one": {"joints": joints}}, split="pool")
    return created


@pytest.fixture
def project(client: Client, settings: Settings, unranked: UUID) -> UUID:
    """The same with a queue at random."""
    with pytest.raises(NotReady):
        client.acquire(unranked, 1, wait=0)
    work(settings)
    return unranked


def work(settings: Settings) -> int:
    """Do the jobs that wait; returns how many there were."""
    worker = open_worker(settings, utc_now, QUEUES)
    done = 0
    while run_next(worker):
        done += 1
    worker.database.close()
    return done


def test_labels_whose_answer_is_lost_are_stored_once_and_give_the_same_receipts(
    client: Client, wire: LossyWire, project: UUID
) -> None:
    batch = client.acquire(project, 4)
    items = [LabelItem(trajectory=item.trajectory, start=item.start, actions=[1]) for item in batch.items]
    wire.answers.clear()
    wire.losses = 2
    request = LabelsRequest(project=project, acquisition=batch.id, token=batch.token, items=items)
    accepted = client.label(request)
    assert (accepted.created, accepted.duplicates) == (4, 0)
    assert [receipt.status for receipt in accepted.receipts] == ["created"] * 4
    assert [answer.status_code for answer in wire.answers] == [201] * 3
    assert len({answer.content for answer in wire.answers}) == 1
    assert [answer.headers.get("Idempotency-Replayed") for answer in wire.answers] == [None, "true", "true"]
    stored = [(label.trajectory, label.start) for label in client.labels(project)]
    assert sorted(stored) == sorted((item.trajectory, item.start) for item in items)
    told = [event for event in client.events(project) if event.kind == "labels.accepted"]
    assert [event.data["count"] for event in told] == [4]
    assert (told[0].actor, len(told[0].correlation) > 0) == ("local", True)


def test_a_batch_whose_answer_is_lost_is_given_out_once(client: Client, wire: LossyWire, project: UUID) -> None:
    wire.losses = 1
    batch = client.acquire(project, 4)
    counts = client.project(project).counts
    assert (len(batch.items), counts.leased, counts.unlabeled) == (4, 4, 8)
    assert [event.kind for event in client.events(project)].count("lease.given") == 1


def test_a_key_of_ones_own_outlives_the_client_and_stands_for_one_body(
    client: Client, wire: LossyWire, project: UUID
) -> None:
    wire.losses = 100
    with pytest.raises(Unreachable, match="the connection broke before the answer came"):
        client.acquire(project, 4, idempotency_key="shift-7")
    wire.losses = 0
    batch = Client(ADDRESS, transport=wire).acquire(project, 4, idempotency_key="shift-7")
    assert (len(batch.items), client.project(project).counts.leased) == (4, 4)
    with pytest.raises(Invalid, match="'shift-7' was used for another body of POST /acquire"):
        client.acquire(project, 5, idempotency_key="shift-7")


def test_other_posts_are_not_sent_again(client: Client, wire: LossyWire, project: UUID) -> None:
    batch = client.acquire(project, 4)
    wire.answers.clear()
    wire.losses = 1
    with pytest.raises(Unreachable):
        client.release(batch.id, batch.token or 0)
    assert len(wire.answers) == 1


def test_acquire_is_answered_as_soon_as_the_queue_is_ranked(
    client: Client, wire: LossyWire, settings: Settings, unranked: UUID
) -> None:
    def job_is_queued() -> bool:
        return any(job.state == "queued" for job in client.jobs(unranked))

    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(client.acquire, unranked, 20, wait=30)
        deadline = time.monotonic() + 20
        while not job_is_queued():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert work(settings) > 0
        batch = asked.result(timeout=30)
    assert batch.reason == "20 were asked for, 12 are left in the pool split"
    assert len(batch.items) == 12
    assert [answer.status_code for answer in wire.answers][-1] == 201
    assert len([answer for answer in wire.answers if "lease_expires_at" in answer.text]) == 1
    assert len(wire.answers) <= 5  # a project, trajectories, then one answer that names the job and one that was held
