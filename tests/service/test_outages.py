"""A PostgreSQL that ends a connection or does not answer in time: a problem to try again, and nothing half stored."""

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from uuid import uuid4

import pytest
from httpx2 import Response
from sqlalchemy import Engine, create_engine, text
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service import projects
from service.store import database
from service.store.queries import labels as label_queries
from service.store.tables import ProjectRow
from tests.loop.processes import eventually
from tests.service.conftest import Serve
from tests.service.kit import Json, Served, answers, refused, room


@pytest.fixture
def beside(postgres_url: str) -> Iterator[Engine]:
    """Connections of the test's own, which see what goes on now."""
    engine = create_engine(postgres_url, isolation_level="AUTOCOMMIT")
    yield engine
    engine.dispose()


@contextmanager
def locked_labels(beside: Engine) -> Iterator[None]:
    """Nobody may write a label meanwhile, all may read."""
    with beside.connect() as connection:
        connection.execute(text("BEGIN"))
        connection.execute(text("LOCK TABLE label IN EXCLUSIVE MODE"))
        yield
        connection.execute(text("ROLLBACK"))


def batch(served: Served) -> tuple[str, Json]:
    """A project, and labels for it."""
    project = served.project()
    served.upload(project, room(0))
    given = served.acquire(project, 3)
    return project, {
        "project": project,
        "items": answers(given),
        "acquisition": given["id"],
        "token": given["token"],
    }


def send(served: Served, body: Json) -> Response:
    return served.another_client().post("/labels", json=body, headers={"Idempotency-Key": "the same"})


def test_labels_that_wait_too_long_for_a_lock_are_to_be_sent_again(
    start: Serve, postgres_url: str, beside: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(database.WAITS, "lock_timeout", 300)
    served = start(database_url=postgres_url)
    project, body = batch(served)
    with locked_labels(beside):
        answer = send(served, body)
    refused(answer, 503, "database-unavailable", "try again")
    assert answer.headers["retry-after"] == "1"
    assert send(served, body).json()["created"] == 3
    assert served.show(project)["label_watermark"] == 3


def test_labels_whose_connection_is_ended_are_to_be_sent_again(start: Serve, postgres_url: str, beside: Engine) -> None:
    served = start(database_url=postgres_url)
    project, body = batch(served)
    copying = text("SELECT pid FROM pg_stat_activity WHERE query LIKE 'COPY label%' AND wait_event_type = 'Lock'")
    with ThreadPoolExecutor(1) as threads, locked_labels(beside), beside.connect() as connection:
        sent = threads.submit(send, served, body)
        eventually(lambda: connection.scalar(copying) is not None, 20, "no COPY waits")
        connection.execute(text("SELECT pg_terminate_backend(:pid)"), {"pid": connection.scalar(copying)})
        answer = sent.result(timeout=20)
    refused(answer, 503, "database-unavailable", "try again")
    assert send(served, body).json()["created"] == 3
    assert served.show(project)["label_watermark"] == 3


def test_a_transaction_that_stood_still_for_too_long_is_to_be_done_again(
    start: Serve, postgres_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(database.WAITS, "idle_in_transaction_session_timeout", 1000)
    served, find = start(database_url=postgres_url), projects.find
    project = served.project()

    def stand_still(session: Session, *arguments: object, **options: object) -> ProjectRow:
        find(session, *arguments, **options)  # type: ignore[arg-type]
        time.sleep(1)
        session.expire_all()
        return find(session, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(projects, "find", stand_still)
    refused(served.client.get(f"/projects/{project}"), 503, "database-unavailable", "try again")
    monkeypatch.setattr(projects, "find", find)
    assert served.show(project)["id"] == project


def test_a_label_that_breaks_a_rule_of_the_database_is_an_integrity_error(on_postgres: Served) -> None:
    """As for a statement that SQLAlchemy sends itself; labels are copied by the driver."""
    columns: Json = {"id": uuid4(), "project_id": uuid4(), "trajectory_id": "f" * 64, "start": 0, "split": "pool"}
    more: Json = {"actions": [0], "action_sets": None, "content_sha256": "0" * 64, "residual": None, "source": {}}
    rest: Json = {"acquisition_id": None, "watermark": 1, "created_at": on_postgres.clock()}
    with pytest.raises(IntegrityError, match="foreign key"), on_postgres.services.database.write() as session:
        label_queries.insert(session, [columns | more | rest])
