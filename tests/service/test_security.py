"""Who may ask: this machine without a key, others with one, and no page of another site."""

from collections.abc import Iterator

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from service.store.tables import KeyRow
from tests.service.conftest import Serve
from tests.service.kit import ROOM, UNKNOWN, Json, Served, npz, refused, room

NEW: Json = {"name": "rooms", "environment": ROOM}


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "localhost@evil"])
def test_a_foreign_host_is_refused_even_for_reading(served: Served, host: str) -> None:
    for answer in (
        served.client.get("/projects", headers={"Host": host}),
        served.client.get("/health/live", headers={"Host": host}),
        served.client.post("/projects", json=NEW, headers={"Host": host}),
    ):
        refused(answer, 403, "cross-origin", "host", repr(host))


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:8000", "localhost", "localhost:65535", "[::1]", "[::1]:8000"])
def test_the_services_own_names_are_let_in(served: Served, host: str) -> None:
    assert served.client.get("/projects", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "http://127.0.0.1:81", "http://localhost", "null", "", "http://[", "127.0.0.1"]
)
def test_a_page_of_another_origin_may_not_write(served: Served, origin: str) -> None:
    project = served.project()
    headers = {"Origin": origin}
    for answer in (
        served.client.post("/projects", json=NEW, headers=headers),
        served.client.patch(f"/projects/{project}", json={"round_labels": 7}, headers=headers),
        served.client.delete(f"/keys/{UNKNOWN}", headers=headers),
    ):
        refused(answer, 403, "cross-origin", "origin", repr(origin))
    assert [row["id"] for row in served.get("/projects")["items"]] == [project]
    assert served.show(project)["policy"]["round_labels"] == 0


def test_a_page_of_the_services_own_may_write(served: Served) -> None:
    assert served.client.post("/projects", json=NEW, headers={"Origin": "http://127.0.0.1"}).status_code == 201
    headers = {"Origin": "http://localhost:8000", "Host": "localhost:8000"}
    assert served.client.post("/projects", json=NEW | {"name": "b"}, headers=headers).status_code == 201


def test_a_body_over_the_limit_is_refused_whether_it_says_its_length_or_not(start: Serve) -> None:
    served = start(max_body_bytes=1000)
    long = b'{"name": "' + b"x" * 2000 + b'"}'
    answer = served.client.post("/projects", content=long, headers={"Content-Type": "application/json"})
    refused(answer, 413, "body-too-large", len(long), 1000)

    def chunks() -> Iterator[bytes]:
        yield long[:1500]
        yield long[1500:]

    answer = served.client.post("/projects", content=chunks(), headers={"Content-Type": "application/json"})
    refused(answer, 413, "body-too-large", 1000)
    assert served.client.post("/projects", json=NEW).status_code == 201


def key(served: Served, *scopes: str) -> dict[str, str]:
    """Headers of a new key."""
    answer = served.client.post("/keys", json={"name": "ada", "scopes": scopes})
    assert answer.status_code == 201
    return {"Authorization": f"Bearer {answer.json()['secret']}"}


def test_a_key_may_do_what_its_scopes_say(served: Served) -> None:
    project = served.project()
    served.upload(project, room(0))
    reads = ["/projects", f"/projects/{project}", "/strategies", "/events", "/metrics"]
    reads += [f"/{name}?project={project}" for name in ("trajectories", "labels", "rounds", "models", "jobs")]
    reader, labeler, acquirer, admin = (key(served, scope) for scope in ("read", "label", "acquire", "admin"))
    for path in reads:
        assert served.client.get(path, headers=reader).status_code == 200
        assert served.client.get(path, headers=admin).status_code == 200
        refused(served.client.get(path, headers=labeler), 403, "not-allowed", "'read'", "label")
    files = [("files", ("0.npz", npz(room(1))))]
    writes = {
        "/acquire": ("acquire", {"json": {"project": project, "count": 1}}, 202),
        "/labels": ("label", {"json": {"project": project, "items": []}}, 422),
        f"/trajectories?project={project}": ("label", {"files": files}, 201),
        "/rounds": ("admin", {"json": {"project": project}}, 409),
        "/keys": ("admin", {"json": {"name": "b", "scopes": ["read"]}}, 201),
        "/projects": ("admin", {"json": NEW}, 201),
        "/collections": ("admin", {"json": {"project": project, "transitions": 1}}, 202),
    }
    holders = {"read": reader, "label": labeler, "acquire": acquirer}
    for path, (scope, body, status) in writes.items():
        for name, headers in holders.items():
            if name != scope:
                answer = served.client.post(path, headers=headers, **body)  # type: ignore[arg-type]
                refused(answer, 403, "not-allowed", repr(scope), name)
        allowed = served.client.post(path, headers=holders.get(scope, admin), **body)  # type: ignore[arg-type]
        assert allowed.status_code == status, (path, allowed.text)
    refused(served.client.patch(f"/projects/{project}", json={}, headers=reader), 403, "not-allowed")


def test_a_revoked_key_opens_nothing_even_on_this_machine(served: Served) -> None:
    created = served.client.post("/keys", json={"name": "ada", "scopes": ["read"]})
    body = created.json()
    headers = {"Authorization": f"Bearer {body['secret']}"}
    assert created.headers["location"] == f"/keys/{body['id']}"
    assert served.client.get("/projects", headers=headers).status_code == 200
    assert served.client.delete(f"/keys/{body['id']}").status_code == 204
    refused(served.client.get("/projects", headers=headers), 401, "unauthenticated")
    refused(served.client.delete(f"/keys/{body['id']}"), 404, "unknown-resource", body["id"])


@pytest.mark.parametrize("secret", ["x", "asim__", "asim_zz_y", f"asim_{'0' * 32}_secret", "asim_\u00e9_x"])
def test_a_made_up_key_opens_nothing(served: Served, secret: str) -> None:
    answer = served.client.get("/projects", headers=[(b"Authorization", f"Bearer {secret}".encode())])
    refused(answer, 401, "unauthenticated")
    assert answer.headers["www-authenticate"] == "Bearer"


def test_only_the_hash_of_a_secret_is_kept(served: Served) -> None:
    secret = served.client.post("/keys", json={"name": "ada", "scopes": ["read", "label"]}).json()["secret"]
    with served.services.database.read() as session:
        row = session.scalars(select(KeyRow)).one()
        assert row.scopes == ["read", "label"]
        assert all(secret not in str(value) for value in vars(row).values())
    served.services.database.close()
    written = b"".join(path.read_bytes() for path in served.settings.data_folder.glob("asim.db*"))
    assert b"ada" in written
    assert secret.encode() not in written
    assert secret.split("_", 2)[2].encode() not in written
    assert secret not in served.client.get("/events").text


def test_a_key_with_part_of_a_secret_changed_opens_nothing(served: Served) -> None:
    headers = key(served, "admin")
    wrong = headers["Authorization"][:-1] + ("a" if headers["Authorization"][-1] != "a" else "b")
    refused(served.client.get("/projects", headers={"Authorization": wrong}), 401, "unauthenticated")


@pytest.mark.parametrize(
    "body", [{"name": "", "scopes": ["read"]}, {"name": "a", "scopes": []}, {"name": "a", "scopes": ["root"]}]
)
def test_a_key_that_makes_no_sense_is_refused(served: Served, body: dict[str, object]) -> None:
    refused(served.client.post("/keys", json=body), 422, "malformed-request")


def test_scaled_out_nothing_is_open_without_a_key_but_health(start: Serve) -> None:
    headers = key(start(), "admin")
    scaled = start(broker_url="memory://")
    paths = ["/projects", "/strategies", "/events", "/metrics", f"/jobs/{UNKNOWN}", f"/trajectories?project={UNKNOWN}"]
    for path in paths:
        answer = scaled.client.get(path)
        refused(answer, 401, "unauthenticated", "Bearer")
        assert answer.headers["www-authenticate"] == "Bearer"
    for path in ("/projects", "/acquire", "/labels", "/rounds", "/keys", "/collections"):
        refused(scaled.client.post(path, json=_bodies(path)), 401, "unauthenticated")
    assert scaled.client.get("/health/live").status_code == 200
    assert scaled.client.get("/projects", headers=headers).status_code == 200


def _bodies(path: str) -> dict[str, object]:
    bodies: dict[str, dict[str, object]] = {
        "/projects": NEW,
        "/acquire": {"project": UNKNOWN, "count": 1},
        "/keys": {"name": "a", "scopes": ["admin"]},
        "/collections": {"project": UNKNOWN, "transitions": 1},
    }
    return bodies.get(path, {"project": UNKNOWN})


def test_another_machine_needs_a_key_in_embedded_mode_too(served: Served) -> None:
    far = TestClient(served.app, base_url="http://127.0.0.1", client=("192.0.2.7", 40000))
    refused(far.get("/projects"), 401, "unauthenticated")
    assert far.get("/projects", headers=key(served, "read")).status_code == 200
    near = TestClient(served.app, base_url="http://127.0.0.1", client=("::1", 40000))
    assert near.get("/projects").status_code == 200
