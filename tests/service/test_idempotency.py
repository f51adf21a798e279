"""One Idempotency-Key, one effect, one answer: repeated, at once, by others, later; a refusal is not kept."""

import base64
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from typing import Any
from uuid import uuid4

import pytest
from httpx2 import Response

from service.store.blobs import Blobs
from service.store.errors import BlobsUnavailable
from tests.service.conftest import Serve
from tests.service.kit import Json, Served, answers, npz, refused, room
from tests.service.test_security import key

CALLERS = 20


def filled(served: Served, trajectories: int = 4, **fields: Any) -> str:
    """A project with five segments a trajectory, whose queue is ready."""
    project = served.project(**fields)
    served.upload(project, *[room(seed) for seed in range(trajectories)])
    served.ask(project)
    served.drain()
    return project


def once(served: Served, path: str, body: Json, named: str, **headers: str) -> Response:
    """The request under this key."""
    return served.client.post(path, json=body, headers={"Idempotency-Key": named} | headers)


def at_once(served: Served, bodies: Sequence[Json], **headers: str) -> list[Response]:
    """POST /labels of all bodies at the same moment."""
    together = Barrier(len(bodies))

    def send(body: Json) -> Response:
        client = served.another_client()
        together.wait(timeout=30)
        return client.post("/labels", json=body, headers=headers)

    with ThreadPoolExecutor(len(bodies)) as threads:
        return list(threads.map(send, bodies))


def replayed(answer: Response) -> bool:
    return answer.headers.get("idempotency-replayed") == "true"


def test_a_batch_asked_for_twice_under_one_key_is_one(on_both: Served) -> None:
    project, named = filled(on_both), uuid4().hex
    body = {"project": project, "count": 3}
    first, second = once(on_both, "/acquire", body, named), once(on_both, "/acquire", body, named)
    assert (first.status_code, replayed(first), replayed(second)) == (201, False, True)
    assert (second.status_code, second.content) == (first.status_code, first.content)
    assert second.headers["location"] == first.headers["location"] == f"/acquisitions/{first.json()['id']}"
    assert on_both.show(project)["counts"]["leased"] == 3
    assert once(on_both, "/acquire", body, uuid4().hex).json()["id"] != first.json()["id"]


def test_labels_sent_twice_under_one_key_get_the_first_receipts(on_both: Served) -> None:
    project, named = filled(on_both), uuid4().hex
    batch = on_both.acquire(project, 3)
    body = {"project": project, "items": answers(batch), "acquisition": batch["id"], "token": batch["token"]}
    first, second = once(on_both, "/labels", body, named), once(on_both, "/labels", body, named)
    assert first.json()["created"] == 3
    assert (second.status_code, second.content, replayed(second)) == (201, first.content, True)
    assert once(on_both, "/labels", body, uuid4().hex).json()["duplicates"] == 3
    assert on_both.show(project)["label_watermark"] == 3


def test_a_key_stands_for_one_body_of_one_route(on_both: Served) -> None:
    project, named = filled(on_both), uuid4().hex
    batch = once(on_both, "/acquire", {"project": project, "count": 2}, named).json()
    refused(
        once(on_both, "/acquire", {"project": project, "count": 3}, named), 422, "idempotency-key-reused", repr(named)
    )
    assert on_both.show(project)["counts"]["leased"] == 2
    labels = {"project": project, "items": answers(batch), "acquisition": batch["id"], "token": batch["token"]}
    assert once(on_both, "/labels", labels, named).json()["created"] == 2
    refused(once(on_both, "/labels", labels | {"items": answers(batch, 1)}, named), 422, "idempotency-key-reused")
    assert {row["actions"][0] for row in on_both.get("/labels", project=project)["items"]} == {0}


@pytest.mark.parametrize("named", ["", "x" * 201, "caf\u00e9", "a\tb"])
def test_a_key_that_cannot_be_kept_is_refused(served: Served, named: str) -> None:
    body = {"project": served.project(), "count": 1}
    answer = served.client.post("/acquire", json=body, headers=[(b"Idempotency-Key", named.encode("latin-1"))])
    refused(answer, 422, "invalid-field", "Idempotency-Key", "1 to 200 printable")


def test_the_same_labels_at_once_under_one_key_are_stored_once_and_answered_alike(on_both: Served) -> None:
    project = filled(on_both)
    batch = on_both.acquire(project, 5)
    body = {"project": project, "items": answers(batch), "acquisition": batch["id"], "token": batch["token"]}
    given = at_once(on_both, [body] * CALLERS, **{"Idempotency-Key": uuid4().hex})
    assert {answer.status_code for answer in given} == {201}
    assert len({answer.content for answer in given}) == 1
    assert sum(not replayed(answer) for answer in given) == 1
    assert given[0].json()["created"] == on_both.show(project)["label_watermark"] == 5
    accepted = [event for event in on_both.events(project) if event["kind"] == "labels.accepted"]
    assert len(accepted) == 1


def test_the_same_labels_at_once_without_a_key_are_stored_once(on_both: Served) -> None:
    project = filled(on_both)
    batch = on_both.acquire(project, 5)
    body = {"project": project, "items": answers(batch), "acquisition": batch["id"], "token": batch["token"]}
    given = at_once(on_both, [body] * CALLERS)
    assert {answer.status_code for answer in given} == {201}
    assert sorted(answer.json()["created"] for answer in given) == [0] * (CALLERS - 1) + [5]
    assert on_both.show(project)["label_watermark"] == 5


def test_of_different_labels_at_once_one_is_stored_and_the_others_are_told_which(on_both: Served) -> None:
    project = filled(on_both)
    batch = on_both.acquire(project, 2)
    lease = {"project": project, "acquisition": batch["id"], "token": batch["token"]}
    given = at_once(on_both, [lease | {"items": answers(batch, number % 7)} for number in range(14)])
    kept = [answer for answer in given if answer.status_code == 201]
    stored = on_both.get("/labels", project=project)["items"]
    assert len({tuple(row["actions"]) for row in stored}) == 1
    assert (len(stored), sum(answer.json()["created"] for answer in kept), len(kept)) == (2, 2, 2)
    for answer in given:
        if answer not in kept:
            refused(answer, 409, "label-conflict", stored[0]["actions"])


def test_batches_asked_for_at_once_under_one_key_are_one(on_both: Served) -> None:
    project, together = filled(on_both), Barrier(8)
    headers = {"Idempotency-Key": uuid4().hex}

    def ask(_: int) -> Response:
        client = on_both.another_client()
        together.wait(timeout=30)
        return client.post("/acquire", json={"project": project, "count": 2}, headers=headers)

    with ThreadPoolExecutor(8) as threads:
        given = list(threads.map(ask, range(8)))
    assert {answer.status_code for answer in given} == {201}
    assert len({answer.content for answer in given}) == 1
    assert on_both.show(project)["counts"]["leased"] == 2


def test_the_key_of_another_caller_is_another_key(on_both: Served) -> None:
    project, named = filled(on_both), uuid4().hex
    body = {"project": project, "count": 1}
    one, other = key(on_both, "acquire"), key(on_both, "acquire")
    given = [once(on_both, "/acquire", body, named, **headers) for headers in ({}, one, other)]
    assert [answer.status_code for answer in given] == [201] * 3
    assert not any(replayed(answer) for answer in given)
    assert len({answer.json()["id"] for answer in given}) == 3
    assert once(on_both, "/acquire", body, named, **one).content == given[1].content


def test_a_key_is_forgotten_after_its_time(on_both: Served) -> None:
    project, named = filled(on_both), uuid4().hex
    keep = on_both.settings.idempotency_hours * 3600
    first = once(on_both, "/acquire", {"project": project, "count": 1}, named)
    on_both.clock.advance(keep - 60)
    assert replayed(once(on_both, "/acquire", {"project": project, "count": 1}, named))
    on_both.clock.advance(61)
    again = once(on_both, "/acquire", {"project": project, "count": 2}, named)
    assert (again.status_code, replayed(again)) == (201, False)
    assert again.json()["id"] != first.json()["id"]


def test_a_key_that_is_used_again_at_once_after_its_time_stands_for_one_request(on_both: Served) -> None:
    project, headers = filled(on_both), {"Idempotency-Key": uuid4().hex}
    body = {"project": project, "items": answers(on_both.acquire(project, 1))}
    on_both.clock.advance(3600)  # the lease ends
    for _ in range(5):
        given = at_once(on_both, [body] * CALLERS, **headers)
        assert {answer.status_code for answer in given} == {201}
        assert len({answer.content for answer in given}) == 1
        assert sum(not replayed(answer) for answer in given) == 1
        on_both.clock.advance(on_both.settings.idempotency_hours * 3600 + 60)
    assert on_both.show(project)["label_watermark"] == 1


def test_labeled_trajectories_sent_twice_need_no_blob_store_for_the_known_answer(
    on_both: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: object) -> None:
        raise BlobsUnavailable("trajectories/x", "it is away")

    project, named = on_both.project(), uuid4().hex
    upload = {"content": base64.b64encode(npz(room(0))).decode(), "actions": [0] * 5}
    body = {"project": project, "trajectories": [upload]}
    first = once(on_both, "/labels", body, named)
    monkeypatch.setattr(Blobs, "put", away)
    second = once(on_both, "/labels", body, named)
    assert (first.status_code, second.status_code, replayed(second)) == (201, 201, True)
    assert second.content == first.content
    other = body | {"trajectories": [upload | {"starts": [0]}]}
    refused(once(on_both, "/labels", other, named), 422, "idempotency-key-reused")
    refused(once(on_both, "/labels", body, uuid4().hex), 503, "blobs-unavailable")


def test_a_refused_request_keeps_nothing(on_both: Served) -> None:
    project, named = filled(on_both, trajectories=1), uuid4().hex
    held = on_both.acquire(project, 5)
    refused(once(on_both, "/acquire", {"project": project, "count": 1}, named), 409, "pool-exhausted")
    strategy = {"project": project, "count": 1, "strategy": "psychic"}
    refused(once(on_both, "/acquire", strategy, named), 422, "unknown-strategy")
    items = answers(held)
    refused(once(on_both, "/labels", {"project": project, "items": items}, named), 423, "segment-leased")
    release = {"token": held["token"]}
    assert on_both.client.post(f"/acquisitions/{held['id']}/release", json=release).status_code == 200
    given = once(on_both, "/acquire", {"project": project, "count": 1}, named)
    assert (given.status_code, replayed(given)) == (201, False)
    mine = [(item["trajectory"], item["start"]) for item in given.json()["items"]]
    items = [item for item in items if (item["trajectory"], item["start"]) not in mine]
    assert once(on_both, "/labels", {"project": project, "items": items}, named).json()["created"] == 4


def test_an_answer_to_wait_for_is_not_kept(on_both: Served) -> None:
    project, named = on_both.project(), uuid4().hex
    on_both.upload(project, room(0))
    body = {"project": project, "count": 1}
    assert [once(on_both, "/acquire", body, named).status_code for _ in range(2)] == [202, 202]
    on_both.drain()
    given = once(on_both, "/acquire", body, named)
    assert (given.status_code, replayed(given)) == (201, False)
    assert replayed(once(on_both, "/acquire", body, named))


def test_a_kept_answer_outlives_the_process(start: Serve) -> None:
    one, named = start(), uuid4().hex
    project = filled(one)
    first = once(one, "/acquire", {"project": project, "count": 2}, named)
    again = once(start(), "/acquire", {"project": project, "count": 2}, named)
    assert (again.content, replayed(again)) == (first.content, True)
