"""`Prefer: wait` holds an answer back until there is a batch, or the time is over."""

import json
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
import uvicorn
from httpx2 import Response

from tests.loop.processes import eventually
from tests.service.kit import Served, room


def fresh(served: Served) -> str:
    """A project that nothing is ranked in."""
    project = served.project()
    served.upload(project, room(0))
    return project


def ask(served: Served, project: str, prefer: str) -> Response:
    body = {"project": project, "count": 2}
    return served.another_client().post("/acquire", json=body, headers={"Prefer": prefer})


def test_an_answer_is_held_until_the_batch_is_ready(on_both: Served) -> None:
    project = fresh(on_both)
    with ThreadPoolExecutor(1) as threads:
        held = threads.submit(ask, on_both, project, "wait=25")
        deadline = time.monotonic() + 20
        while not on_both.get("/jobs", project=project)[
            "items"
        ]:  # the request has found no queue: it waits from now on
            assert time.monotonic() < deadline
            assert not held.done()
        on_both.drain()
        answer = held.result(timeout=20)
    assert answer.status_code == 201
    assert answer.headers["preference-applied"] == "wait=25"
    assert len(answer.json()["items"]) == 2
    assert on_both.show(project)["counts"]["leased"] == 2


def test_when_the_time_is_over_the_answer_is_the_job_to_wait_for(served: Served) -> None:
    project, begun = fresh(served), time.monotonic()
    answer = ask(served, project, "wait=1")
    assert 1 <= time.monotonic() - begun < 10
    assert answer.status_code == 202
    assert answer.headers["preference-applied"] == "wait=1"
    assert answer.headers["retry-after"] == "1"
    assert answer.headers["location"] == f"/jobs/{answer.json()['job']}"
    assert len(served.get("/jobs", project=project)["items"]) == 1


@contextmanager
def listening(served: Served) -> Iterator[int]:
    """The service on a real socket; its port."""
    config = uvicorn.Config(served.app, port=0, lifespan="off", log_level="warning")
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        eventually(lambda: server.started, 20, "the service does not listen")
        try:
            yield int(listener.getsockname()[1])
        finally:
            server.should_exit = True
            thread.join(timeout=30)
    assert not thread.is_alive()


def test_nothing_is_leased_for_a_client_that_has_gone(served: Served) -> None:
    project = fresh(served)
    body = json.dumps({"project": project, "count": 2}).encode()
    head = "POST /acquire HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nPrefer: wait=25\r\n"
    with listening(served) as port:
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
            eventually(lambda: bool(served.get("/jobs", project=project)["items"]), 20, "the request does not wait")
        served.drain()
    assert served.show(project)["counts"]["leased"] == 0
    assert not [event for event in served.events(project) if event["kind"] == "lease.given"]


@pytest.mark.parametrize(
    ("prefer", "applied"),
    [
        ("wait=5", "wait=5"),
        ("wait=31", "wait=30"),
        ("wait=99999999999", "wait=30"),
        ("respond-async, Wait = 7", "wait=7"),
        ("respond-async", None),
        ("wait=0", None),
        ("wait=soon", None),
        ("await=5", None),
        ("wait=-5", None),
        ("", None),
    ],
)
def test_a_wish_that_is_understood_is_confirmed_within_bounds(served: Served, prefer: str, applied: str | None) -> None:
    project = fresh(served)
    served.acquire(project)
    begun = time.monotonic()
    answer = ask(served, project, prefer)
    assert answer.status_code == 201
    assert answer.headers.get("preference-applied") == applied
    assert time.monotonic() - begun < 5
