"""What each key reaches, asked of every endpoint; and keys that are limited, have expired, or failed too often."""

import json
from collections.abc import Mapping
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from limits import RateLimitItemPerSecond
from starlette.types import Message

from service import keys
from service.api.attempts import FailedKeys, TooManyFailedKeys
from tests.service.access_table import DOCUMENT, ELSEWHERE, Things, ask, endpoints, fill, holder, stranger, table
from tests.service.conftest import Serve
from tests.service.kit import UNKNOWN, Served, refused

OPEN = {"/health/live", "/health/ready"}
HERE = ("127.0.0.1", 50000)


def test_the_document_tells_what_every_endpoint_answers_to_every_key(served: Served) -> None:
    assert table(served) == DOCUMENT.read_text(), "write it anew: python -m tests.service.access_table"


def test_every_endpoint_but_health_says_that_it_needs_a_key(served: Served) -> None:
    assert {endpoint.path for endpoint in endpoints(served) if not endpoint.locked} == OPEN


def test_a_key_of_one_project_reads_and_changes_nothing_of_another(on_both: Served) -> None:
    """Of the other project's things none is answered, none is changed, and none is known to be there."""
    ours, theirs = fill(on_both, "ours", 1), fill(on_both, "theirs", 2)
    before = on_both.show(theirs.project)
    headers = holder(on_both, "admin", project=ours.project)
    for endpoint in endpoints(on_both):
        if endpoint.path in OPEN:
            continue
        mine, others = dict(ours.ids), dict(theirs.ids)
        for ids in (others, mine | {"project_id": theirs.project}, others | {"project_id": ours.project}):
            mixed = Things(ids["project_id"], ids)
            answer = ask(stranger(on_both), endpoint, mixed, headers)
            told = json.dumps(answer.json()) if "json" in answer.headers["content-type"] else answer.text
            asked = endpoint.path.format(**ids)
            named = [value for value in theirs.ids.values() if value in told.replace(asked, "")]
            if answer.is_success:
                assert named == [], endpoint.name
            else:
                assert answer.status_code in (403, 404, 422), (endpoint.name, answer.text)
    assert on_both.show(theirs.project) == before


def test_what_is_anothers_is_as_unknown_as_what_is_not_there(served: Served) -> None:
    ours, theirs = fill(served, "ours", 1), fill(served, "theirs", 2)
    client, headers = stranger(served), holder(served, "admin", project=ours.project)
    for noun in ("acquisition", "round", "model", "job"):
        found = [
            client.get(f"/{noun}s/{name}", headers=headers).json()["detail"].replace(name, "X")
            for name in (theirs.ids[f"{noun}_id"], UNKNOWN, "no-id")
        ]
        assert found == [f"there is no {noun} 'X'"] * 3
        assert client.get(f"/{noun}s/{ours.ids[f'{noun}_id']}", headers=headers).status_code == 200
    for query in ({"project": theirs.project}, {"project": UNKNOWN}):
        refused(client.get("/labels", params=query, headers=headers), 404, "unknown-resource", query["project"])
        refused(client.get("/events", params=query, headers=headers), 404, "unknown-resource", query["project"])
        refused(client.post("/acquire", json=query, headers=headers), 404, "unknown-resource", query["project"])
    bodies: list[object] = [{}, {"project": None}, {"project": "no-id"}, [], "text", None]
    for body in bodies:
        answer = client.post("/acquire", json=body, headers=headers)
        refused(answer, 422, "invalid-field", "project", ours.project)


def test_listings_tell_a_key_of_one_project_of_that_alone(served: Served) -> None:
    ours, theirs = fill(served, "ours", 1), fill(served, "theirs", 2)
    client, headers = stranger(served), holder(served, "read", project=ours.project)
    assert [row["id"] for row in client.get("/projects", headers=headers).json()["items"]] == [ours.project]
    told = client.get("/events", params={"newest": True, "limit": 1000}, headers=headers).json()["items"]
    assert {row["project"] for row in told} == {ours.project}
    everybody = client.get("/projects", headers=holder(served, "read")).json()["items"]
    assert {ours.project, theirs.project} <= {row["id"] for row in everybody}


def test_a_key_of_a_project_that_is_not_there_is_refused(served: Served) -> None:
    answer = served.client.post("/keys", json={"name": "a", "scopes": ["read"], "project": UNKNOWN})
    refused(answer, 404, "unknown-resource", UNKNOWN)


def test_an_expired_key_opens_nothing(on_both: Served) -> None:
    end = on_both.clock.now + timedelta(seconds=60)
    asked = {"name": "ada", "scopes": ["read"], "expires_at": end.isoformat()}
    made = on_both.client.post("/keys", json=asked).json()
    headers = {"Authorization": f"Bearer {made['secret']}"}
    assert on_both.client.get("/projects", headers=headers).status_code == 200
    on_both.clock.advance(61)
    refused(on_both.client.get("/projects", headers=headers), 401, "unauthenticated", "expired", end.isoformat())
    answer = on_both.client.post("/keys", json=asked)
    refused(answer, 422, "invalid-field", "expires_at", "future")


def test_keys_are_listed_without_their_secrets(served: Served) -> None:
    project = served.project()
    made = [
        served.client.post("/keys", json={"name": name, "scopes": ["read", "label", "read"], "project": project}).json()
        for name in ("ada", "bob")
    ]
    listed = served.get("/keys", limit=1)
    listed["items"] += served.get("/keys", cursor=listed["next"])["items"]
    assert [row["id"] for row in listed["items"]] == [each["id"] for each in made]
    assert listed["items"][0]["scopes"] == ["read", "label"]
    assert all(
        {**each, "secret": None} == {**row, "secret": None} for each, row in zip(made, listed["items"], strict=True)
    )
    assert not any(each["secret"] in json.dumps(listed) for each in made)


@pytest.mark.parametrize("path", ["/labels", "/trajectories", "/projects", "/acquire"])
def test_nothing_is_read_of_a_body_that_its_sender_may_not_send(served: Served, path: str) -> None:
    """Neither a stranger's, nor of somebody whose key has another scope, or is of one project where all are meant."""
    project = served.project()
    for headers, status in (({}, 401), (holder(served, "read"), 403), (holder(served, "read", project=project), 403)):
        assert bodies_read(served, path, headers) == (status, 0)
    status, read = bodies_read(served, path, holder(served, "admin"))
    assert status not in (401, 403)
    assert read > 0


def bodies_read(served: Served, path: str, headers: Mapping[str, str]) -> tuple[int, int]:
    """The status, and how often the service asked for more of the body of a POST."""
    asked, statuses = 0, list[int]()

    async def receive() -> Message:
        nonlocal asked
        asked += 1
        return {"type": "http.request", "body": b" " * 1000, "more_body": asked < 5}

    async def send(message: Message) -> None:
        statuses.extend([message["status"]] if "status" in message else [])

    kind = "multipart/form-data; boundary=x" if path == "/trajectories" else "application/json"
    told = {"host": "127.0.0.1", "content-type": kind, **headers}
    scope = {"type": "http", "method": "POST", "path": path, "raw_path": path.encode(), "query_string": b""}
    scope |= {"headers": [(name.lower().encode(), value.encode()) for name, value in told.items()]}
    scope |= {"client": ELSEWHERE, "server": ("127.0.0.1", 8000), "scheme": "http", "http_version": "1.1"}
    served.client.portal.call(served.app, scope, receive, send)  # type: ignore[union-attr]  # kit.serve opens it
    return statuses[0], asked


def test_an_answer_that_the_service_failed_to_give_is_counted(start: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    served = start()
    holder(served, "read")
    monkeypatch.setattr(keys, "describe", None)
    client = TestClient(served.app, base_url="http://127.0.0.1", client=HERE, raise_server_exceptions=False)
    assert client.get("/keys").status_code == 500
    assert 'asim_requests_total{method="GET",route="/keys",status="500"} 1.0' in served.client.get("/metrics").text


def test_keyless_asking_can_be_turned_off(start: Serve) -> None:
    served = start()
    headers = holder(served, "read")
    served = start(keyless=False)
    refused(served.client.get("/projects"), 401, "unauthenticated")
    assert served.client.get("/projects", headers=headers).status_code == 200


@pytest.mark.parametrize("header", ["X-Forwarded-For", "Forwarded", "X-Real-IP", "Via", "X-Forwarded-Proto"])
def test_a_proxy_on_this_machine_opens_nothing_to_those_behind_it(served: Served, header: str) -> None:
    refused(served.client.get("/projects", headers={header: "192.0.2.7"}), 401, "unauthenticated")
    assert served.client.get("/projects", headers={header: "192.0.2.7"} | holder(served, "read")).status_code == 200


@pytest.mark.parametrize("shown", ["Basic YTpi", "Bearer", "Bearer ", "asim_0_x"])
def test_what_is_no_bearer_key_is_refused_even_on_this_machine(served: Served, shown: str) -> None:
    refused(served.client.get("/projects", headers={"Authorization": shown}), 401, "unauthenticated", "Bearer")


def test_a_key_that_fails_again_and_again_is_not_looked_up_any_more(start: Serve) -> None:
    served = start()
    forgotten, good = holder(served, "read"), holder(served, "read")
    revoked = served.get("/keys")["items"][0]["id"]
    assert served.client.delete(f"/keys/{revoked}").status_code == 204
    client = stranger(served)
    for _ in range(10):
        refused(client.get("/projects", headers=forgotten), 401, "unauthenticated")
    answer = client.get("/projects", headers=forgotten)
    refused(answer, 429, "too-many-failed-keys", "10 keys", "try again in")
    assert 1 <= int(answer.headers["retry-after"]) <= 60
    assert client.get("/projects", headers=good).status_code == 200  # of the same machine, another key
    for number in range(90):
        made_up = {"Authorization": f"Bearer asim_{number:032x}_x"}
        refused(client.get("/projects", headers=made_up), 401, "unauthenticated")
    assert client.get("/projects", headers=good).status_code == 200  # it opened something before they failed
    new = holder(served, "read")
    refused(client.get("/projects", headers=new), 429, "too-many-failed-keys", "100 keys")
    assert served.client.get("/projects", headers=new).status_code == 200  # another machine
    assert served.client.get("/projects").status_code == 200


def test_failures_are_forgotten_after_their_time() -> None:
    failed = FailedKeys(per_key=RateLimitItemPerSecond(2), per_address=RateLimitItemPerSecond(5))
    for _ in range(2):
        failed.check("192.0.2.7", None)
        failed.count("192.0.2.7", None)
    with pytest.raises(TooManyFailedKeys) as caught:
        failed.check("192.0.2.7", None)
    assert caught.value.headers == {"Retry-After": "1"}
    failed.check("192.0.2.8", None)
    deadline = RateLimitItemPerSecond(1).get_expiry() + 0.2
    assert _passes_within(failed, deadline)


def _passes_within(failed: FailedKeys, seconds: float) -> bool:
    import time

    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            failed.check("192.0.2.7", None)
        except TooManyFailedKeys:
            time.sleep(0.02)
        else:
            return True
    return False


def test_addresses_of_one_ipv6_network_are_one_sender() -> None:
    failed = FailedKeys(RateLimitItemPerSecond(100, 60), RateLimitItemPerSecond(3, 60))
    for number in range(3):
        failed.count(f"2001:db8::{number}", None)
    with pytest.raises(TooManyFailedKeys):
        failed.check("2001:db8::ffff", None)
    failed.check("2001:db8:0:1::1", None)


def test_every_answer_has_the_security_headers(served: Served) -> None:
    answers = [
        served.client.get("/projects"),
        served.client.get("/openapi.json"),
        served.client.get("/nowhere"),
        served.client.get("/projects", headers={"Host": "evil.example"}),
        stranger(served).get("/projects"),
        served.client.post("/projects", content=b"{"),
    ]
    for answer in answers:
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["x-frame-options"] == "DENY"
        assert answer.headers["content-security-policy"] == "default-src 'none'; frame-ancestors 'none'"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["cache-control"] == "no-store"
    page = served.client.get("/dashboard").headers
    assert "script-src 'self'" in page["content-security-policy"]
    assert (page["x-frame-options"], page["cache-control"]) == ("DENY", "no-cache")
