"""What the client does by itself: retries, refusals as exceptions, paging, waiting. The service is a script here."""

import json
from collections.abc import Callable
from pathlib import Path
from uuid import UUID, uuid4

import httpx
import numpy as np
import pytest

import asim
from api_schemas.labels import LabelsRequest
from api_schemas.projects import ProjectPatch
from asim.arrays import pack, unpack
from asim.client import Client
from asim.transport import Transport

PROJECT = UUID(int=7)
Answer = Callable[[httpx.Request], httpx.Response]


class Script:
    """Answers requests in turn, the last answer for ever; remembers what was asked."""

    def __init__(self, *answers: httpx.Response | Exception) -> None:
        self._answers = list(answers)
        self.requests: list[httpx.Request] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        self.requests.append(request)
        answer = self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]
        if isinstance(answer, Exception):
            raise answer
        return answer

    def client(self) -> Client:
        return Client("http://service", transport=httpx.MockTransport(self))

    def transport(self, sleeps: list[float]) -> Transport:
        return Transport("http://service", None, 1.0, httpx.MockTransport(self), sleep=sleeps.append)


def problem(status: int, **more: object) -> httpx.Response:
    body = {"type": "urn:asim:error:x", "title": "x", "status": status, "detail": f"no, {status}", **more}
    return httpx.Response(status, json=body, headers={"Content-Type": "application/problem+json"})


def job(state: str, **more: object) -> dict[str, object]:
    empty = dict.fromkeys(("error", "started_at", "heartbeat_at", "finished_at"))
    return {
        "id": str(UUID(int=1)), "project": str(PROJECT), "kind": "score_shard", "queue": "score", "state": state,
        "attempts": 1, "max_attempts": 5, "progress": 0.5, "message": "", "result": {},
        "created_at": "2026-01-01T00:00:00Z", **empty, **more,
    }  # fmt: skip


def acquisition() -> dict[str, object]:
    return {
        "id": str(uuid4()), "project": str(PROJECT), "mode": "pool", "purpose": "pool", "strategy": "random",
        "requested_strategy": "random", "round": None, "status": "leased", "reason": None, "labeler": "", "token": 3,
        "lease_expires_at": "2026-01-01T00:00:00Z", "created_at": "2026-01-01T00:00:00Z", "items": [],
        "budget": {"total": None, "spent": 0, "reserved": 0, "remaining": None},
    }  # fmt: skip


def pending(of: int = 1, headers: dict[str, str] | None = None) -> httpx.Response:
    return httpx.Response(202, json={"detail": "no ranked queue yet", "job": str(UUID(int=of))}, headers=headers)


HELD = {"Preference-Applied": "wait=20"}
ACCEPTED = {"receipts": [], "created": 0, "duplicates": 0, "watermark": 0, "round": None}
ROUND = {
    "id": str(UUID(int=5)), "project": str(PROJECT), "number": 2, "watermark": 9, "labels": 9, "stages": [],
    "models": {}, "model_error": None, "job": None, "error": None, "created_at": "2026-01-01T00:00:00Z",
    "finished_at": None,
}  # fmt: skip


def event(identity: int) -> dict[str, object]:
    return {
        "id": identity, "project": str(PROJECT), "kind": "labels.accepted", "data": {}, "actor": "local",
        "correlation": "c", "created_at": "2026-01-01T00:00:00Z",
    }  # fmt: skip


@pytest.mark.parametrize("failure", [httpx.ReadError("broken"), problem(503), problem(429)])
def test_a_get_is_asked_again_until_it_is_answered(failure: httpx.Response | Exception) -> None:
    script, sleeps = Script(failure, failure, httpx.Response(200, text="fine")), list[float]()
    assert script.transport(sleeps).request("GET", "/x").text == "fine"
    assert len(script.requests) == 3
    assert 0.2 <= sleeps[0] <= 0.25
    assert 0.4 <= sleeps[1] <= 0.5


def test_retry_after_sets_the_pause() -> None:
    later = problem(503)
    later.headers["Retry-After"] = "3"
    sleeps: list[float] = []
    Script(later, httpx.Response(200)).transport(sleeps).request("GET", "/x")
    assert 3.0 <= sleeps[0] <= 3.75


def test_a_get_gives_up_in_the_end() -> None:
    script, sleeps = Script(httpx.ReadError("broken")), list[float]()
    with pytest.raises(asim.Unreachable, match="no answer from http://service to GET /x: broken"):
        script.transport(sleeps).request("GET", "/x")
    assert len(script.requests) == 6


@pytest.mark.parametrize("failure", [httpx.ReadError("broken"), problem(503)])
def test_a_post_that_may_have_arrived_is_not_sent_again(failure: httpx.Response | Exception) -> None:
    script = Script(failure, httpx.Response(200))
    with pytest.raises((asim.Unreachable, asim.Unavailable)):
        script.transport([]).request("POST", "/x")
    assert len(script.requests) == 1


def test_a_post_that_found_no_connection_is_sent_again() -> None:
    script = Script(httpx.ConnectError("refused"), httpx.Response(201))
    assert script.transport([]).request("POST", "/x").status_code == 201


@pytest.mark.parametrize("failure", [httpx.ReadError("broken"), httpx.ReadTimeout("slow"), problem(502), problem(429)])
def test_labels_are_sent_again_under_the_same_key_until_they_are_answered(
    failure: httpx.Response | Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asim.transport.LONGEST_PAUSE", 0.0)
    script = Script(failure, failure, httpx.Response(201, json=ACCEPTED))
    assert script.client().label(LabelsRequest(project=PROJECT)).created == 0
    keys = [request.headers["Idempotency-Key"] for request in script.requests]
    assert len(keys) == 3
    assert UUID(keys[0]).version == 4
    assert set(keys) == {keys[0]}
    assert len({request.content for request in script.requests}) == 1


def test_each_call_has_a_key_of_its_own_unless_it_is_given_one() -> None:
    script = Script(httpx.Response(201, json=ACCEPTED))
    client = script.client()
    for given in (None, None, "mine"):
        client.label(LabelsRequest(project=PROJECT), idempotency_key=given)
    first, second, mine = (request.headers["Idempotency-Key"] for request in script.requests)
    assert first != second
    assert mine == "mine"


def test_other_posts_carry_no_key_and_are_not_sent_again() -> None:
    script = Script(httpx.ReadError("broken"))
    with pytest.raises(asim.Unreachable):
        script.client().start_round(PROJECT)
    assert len(script.requests) == 1
    assert "Idempotency-Key" not in script.requests[0].headers


@pytest.mark.parametrize(
    ("status", "error"),
    [
        (400, asim.Invalid), (401, asim.Forbidden), (403, asim.Forbidden), (404, asim.NotFound), (409, asim.Conflict),
        (410, asim.Conflict), (423, asim.Conflict),
        (413, asim.Invalid), (422, asim.Invalid), (500, asim.ServiceError),
    ],
)  # fmt: skip
def test_a_refusal_is_raised_as_the_exception_of_its_status(status: int, error: type[asim.ServiceError]) -> None:
    with pytest.raises(asim.ServiceError, match=f"no, {status}") as raised:
        Script(problem(status)).client().label(LabelsRequest(project=PROJECT))
    assert type(raised.value) is error
    assert raised.value.problem.status == status


def test_a_refusal_names_the_refused_fields() -> None:
    params = [{"name": "items.0.start", "reason": "must not be negative", "value": "-1"}]
    with pytest.raises(asim.Invalid, match=r"no, 422 \[items.0.start: must not be negative \(got -1\)\]"):
        Script(problem(422, invalid_params=params)).client().label(LabelsRequest(project=PROJECT))


def test_an_error_without_problem_details_still_says_what_came() -> None:
    with pytest.raises(asim.ServiceError, match="answered 500 Internal Server Error without saying why"):
        Script(httpx.Response(500, text="<html>")).client().job(PROJECT)


def test_all_pages_are_read_once_each() -> None:
    pages = [{"items": [job("done"), job("done")], "next": "b"}, {"items": [job("failed")], "next": None}]
    script = Script(*(httpx.Response(200, json=page) for page in pages))
    assert [each.state for each in script.client().jobs(PROJECT)] == ["done", "done", "failed"]
    assert [request.url.params.get("cursor") for request in script.requests] == [None, "b"]
    assert {request.url.params["project"] for request in script.requests} == {str(PROJECT)}


def test_acquire_has_the_service_wait_and_asks_again_under_the_same_key() -> None:
    script = Script(
        pending(), pending(1, HELD), httpx.Response(200, json=job("running")), httpx.Response(201, json=acquisition())
    )
    assert script.client().acquire(PROJECT, 4, mode="explore", idempotency_key="k").token == 3
    asked = [f"{request.method} {request.url.path}" for request in script.requests]
    job_path = "GET /jobs/00000000-0000-0000-0000-000000000001"
    assert asked == ["POST /acquire", "POST /acquire", job_path, "POST /acquire"]
    posts = [request for request in script.requests if request.method == "POST"]
    assert [request.headers.get("Prefer") for request in posts] == [None, "wait=20", "wait=20"]
    assert {request.headers["Idempotency-Key"] for request in posts} == {"k"}
    assert {json.loads(request.content)["mode"] for request in posts} == {"explore"}


@pytest.mark.parametrize(
    ("timeout", "wait", "held"), [(10.0, 60.0, "wait=5"), (60.0, 7.9, "wait=7"), (1.0, 60.0, None)]
)
def test_acquire_never_asks_for_a_longer_hold_than_the_wait_or_the_timeout_bear(
    timeout: float, wait: float, held: str | None
) -> None:
    script = Script(pending(), httpx.Response(201, json=acquisition()))
    Client("http://service", timeout=timeout, transport=httpx.MockTransport(script)).acquire(PROJECT, 4, wait=wait)
    assert script.requests[1].headers.get("Prefer") == held


def test_acquire_says_so_when_the_wait_is_over() -> None:
    script = Script(pending())
    with pytest.raises(asim.NotReady, match="no ranked queue yet"):
        script.client().acquire(PROJECT, 4, wait=0)
    assert len(script.requests) == 1


@pytest.mark.parametrize(
    ("state", "error", "sentence"),
    [("failed", asim.JobFailed, "failed: nan"), ("cancelled", asim.JobCancelled, "was cancelled before it was done")],
)
def test_acquire_raises_the_end_of_the_job_that_it_waited_for(
    state: str, error: type[asim.JobFailed], sentence: str
) -> None:
    """By then the service has begun another job: that one is not waited for."""
    ended = job(state, error="nan" if state == "failed" else None)
    script = Script(pending(), pending(2, HELD), httpx.Response(200, json=ended))
    with pytest.raises(error, match=rf"job {UUID(int=1)} \(score_shard\) {sentence}") as raised:
        script.client().acquire(PROJECT, 4)
    assert type(raised.value) is error


def test_a_failed_job_is_raised_with_its_reason() -> None:
    script = Script(httpx.Response(200, json=job("failed", error="segment 12 is not finite")))
    with pytest.raises(asim.JobFailed, match="segment 12 is not finite") as raised:
        script.client().wait_for_job(UUID(int=1))
    assert raised.value.job.state == "failed"


def test_a_cancelled_job_and_a_cancelled_round_are_raised_as_such() -> None:
    with pytest.raises(asim.JobCancelled, match="was cancelled before it was done"):
        Script(httpx.Response(200, json=job("cancelled"))).client().wait_for_job(UUID(int=1))
    cancelled = httpx.Response(200, json=ROUND | {"status": "cancelled"})
    with pytest.raises(asim.RoundCancelled, match=r"round 2 \(.*\) was cancelled before it was current") as raised:
        Script(cancelled).client().wait_for_round(UUID(int=5))
    assert isinstance(raised.value, asim.RoundFailed)


def test_a_job_is_cancelled_by_delete() -> None:
    script = Script(httpx.Response(200, json=job("cancelled")))
    assert script.client().cancel_job(UUID(int=1)).state == "cancelled"
    assert (script.requests[0].method, script.requests[0].url.path) == ("DELETE", f"/jobs/{UUID(int=1)}")


def test_a_lost_lease_is_a_conflict_of_its_own() -> None:
    script = Script(problem(410, type="urn:asim:error:lease-lost"))
    with pytest.raises(asim.LeaseLost) as raised:
        script.client().label(LabelsRequest(project=PROJECT))
    assert isinstance(raised.value, asim.Conflict)


def test_followed_events_come_once_each_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    monkeypatch.setattr("asim.calls.jobs.time.sleep", pauses.append)
    pages = [([1, 2], "a"), ([3], None), ([3, 4], None), ([3, 4, 5], "b"), ([6], None)]
    script = Script(
        *(httpx.Response(200, json={"items": [event(each) for each in ids], "next": cursor}) for ids, cursor in pages)
    )
    followed = script.client().follow_events(PROJECT)
    assert [next(followed).id for _ in range(6)] == [1, 2, 3, 4, 5, 6]
    assert [request.url.params.get("cursor") for request in script.requests] == [None, "a", "a", "a", "b"]
    assert pauses == [1.0, 1.0]


def test_a_patch_carries_only_the_fields_that_are_set() -> None:
    script = Script(problem(404))
    with pytest.raises(asim.NotFound):
        script.client().change_project(PROJECT, ProjectPatch(round_labels=5))
    assert json.loads(script.requests[0].content) == {"round_labels": 5}


def test_trajectories_are_sent_as_npz_files_that_keep_dtype_and_shape() -> None:
    script = Script(httpx.Response(201, json={"items": []}))
    grid = np.arange(24, dtype=np.uint8).reshape(2, 2, 2, 3)
    script.client().add_trajectories(PROJECT, {"a": {"grid": grid}}, split="pool")
    request = script.requests[0]
    assert request.url.params["split"] == "pool"
    assert b'name="files"; filename="a"' in request.content
    assert pack({"grid": grid}) in request.content
    back = unpack(pack({"grid": grid}))["grid"]
    assert back.dtype == np.uint8
    np.testing.assert_array_equal(back, grid)


def test_provenance_is_states_and_metadata() -> None:
    packed = pack({"agent": np.zeros((3, 2)), "__metadata__": np.array('{"seed": 4}')})
    states, metadata = Script(httpx.Response(200, content=packed)).client().provenance(PROJECT, "0" * 64, 1, 2)
    assert list(states) == ["agent"]
    assert metadata == {"seed": 4}


def test_a_key_travels_as_a_bearer_token() -> None:
    script = Script(httpx.Response(200, json=[]))
    Client("http://service", key="secret", transport=httpx.MockTransport(script)).strategies()
    assert script.requests[0].headers["Authorization"] == "Bearer secret"


def test_an_open_file_is_sent_whole_again_where_the_first_attempt_found_no_connection(tmp_path: Path) -> None:
    content = pack({"grid": np.arange(200_000, dtype=np.uint8).reshape(2, -1)})
    (tmp_path / "one.npz").write_bytes(content)
    bodies: list[bytes] = []
    told: list[httpx.Response | Exception] = [httpx.ConnectError("refused"), httpx.Response(201, json={"items": []})]
    answers = iter(told)

    def service(request: httpx.Request) -> httpx.Response:
        bodies.append(request.read())
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    transport = Transport("http://service", None, 1.0, httpx.MockTransport(service), sleep=lambda seconds: None)
    with (tmp_path / "one.npz").open("rb") as file:
        transport.request("POST", "/trajectories", files=[("files", ("one.npz", file, "application/octet-stream"))])
    assert len(bodies) == 2
    assert all(content in body for body in bodies)
