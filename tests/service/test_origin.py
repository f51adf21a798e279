"""Every answer, event and job says on whose request it came about; every state change is an event."""

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, update

from service import events, leases
from service.store.database import migrate
from service.store.tables import EventRow, JobRow, ProjectRow
from tests.service.conftest import Serve
from tests.service.kit import UNKNOWN, Json, Served, answers, refused, room
from tests.service.test_security import key

ID = "X-Correlation-ID"


def said(answer: Any) -> str:
    return str(answer.headers[ID])


def test_an_answer_carries_the_clients_id_or_one_of_our_own(served: Served) -> None:
    for given in ("4711", "a.b_c:d@e-f", "x" * 100):
        assert said(served.client.get("/projects", headers={ID: given})) == given
    own = [said(served.client.get("/projects")) for _ in range(2)]
    assert own[0] != own[1]
    for id_ in own:
        assert UUID(hex=id_)


@pytest.mark.parametrize("given", ["", "x" * 101, "two words", 'quo"te', "caf\u00e9", "semi;colon", "tab\tbed", "{x}"])
def test_an_id_that_has_no_place_in_a_log_line_is_replaced(served: Served, given: str) -> None:
    answer = served.client.get("/projects", headers=[(ID.encode(), given.encode("latin-1"))])
    assert said(answer) != given
    assert UUID(hex=said(answer))


def test_refusals_carry_the_id_too(served: Served) -> None:
    named = {ID: "mine"}
    far = TestClient(served.app, base_url="http://127.0.0.1", client=("192.0.2.7", 40000))
    for answer, status in (
        (served.client.get(f"/projects/{UNKNOWN}", headers=named), 404),
        (served.client.get("/nothing", headers=named), 404),
        (served.client.post("/acquire", json={}, headers=named), 422),
        (served.client.get("/projects", headers=named | {"Host": "evil.example"}), 403),
        (served.client.post("/projects", json={}, headers=named | {"Origin": "http://evil.example"}), 403),
        (served.client.post("/labels", content=b"x" * 5_000_000, headers=named), 413),
        (far.get("/projects", headers=named), 401),
    ):
        assert (answer.status_code, said(answer)) == (status, "mine")


def test_a_failure_of_our_own_carries_the_id_too(served: Served) -> None:
    project = served.project()
    with served.services.database.write() as session:
        session.get_one(ProjectRow, UUID(project)).policy = {"no": "policy"}
    client = TestClient(
        served.app, base_url="http://127.0.0.1", client=("127.0.0.1", 50000), raise_server_exceptions=False
    )
    answer = client.get(f"/projects/{project}", headers={ID: "mine"})
    refused(answer, 500, "internal-error")
    assert said(answer) == "mine"


def happen(served: Served, project: str, headers: dict[str, str]) -> list[str]:
    """A request of each kind that changes a project; the kinds of events that must tell of it, jobs apart."""

    def post(path: str, **body: Any) -> Json:
        answer = served.client.post(path, json=body, headers=headers)
        assert answer.status_code in (200, 201), answer.text
        return dict(answer.json())

    assert served.client.patch(f"/projects/{project}", json={"label_budget": 50}, headers=headers).status_code == 200
    batch = post("/acquire", project=project, count=2)
    lease = {"acquisition": batch["id"], "token": batch["token"]}
    post(f"/acquisitions/{batch['id']}/extend", token=batch["token"])
    post("/labels", project=project, items=answers(batch)[:1], **lease)
    post("/labels", project=project, items=answers(batch), **lease)
    post("/labels", project=project, items=answers(batch), **lease)  # changes nothing: no event
    batch = post("/acquire", project=project, count=2)
    post(f"/acquisitions/{batch['id']}/release", token=batch["token"])
    return [
        *("project.changed", "lease.given", "lease.extended", "labels.accepted", "labels.accepted"),
        *("acquisition.labeled", "lease.given", "lease.released"),
    ]


def of_request(rows: Sequence[Json], correlation: str) -> list[Json]:
    return [row for row in rows if row["correlation"] == correlation and not row["kind"].startswith("job.")]


def test_every_state_change_is_one_event_with_who_and_on_whose_request(on_both: Served) -> None:
    project = on_both.project()
    on_both.upload(project, room(0), room(1))
    on_both.acquire(project)
    admin = key(on_both, "admin")
    secret = admin["Authorization"].split("_")
    for headers, actor in (({}, "local"), (admin, f"key {UUID(hex=secret[1])} ada")):
        correlation = uuid4().hex
        kinds = happen(on_both, project, headers | {ID: correlation})
        rows = of_request(on_both.events(project), correlation)
        assert [row["kind"] for row in rows] == kinds
        assert {row["actor"] for row in rows} == {actor}


def test_an_event_tells_what_happened(on_both: Served) -> None:
    project = on_both.project()
    on_both.upload(project, room(0))
    batch = on_both.acquire(project, 2, labeler="ada")
    on_both.label(project, answers(batch), batch, source={"kind": "robot", "name": "arm 3"})
    told = {row["kind"]: row["data"] for row in on_both.events(project)}
    assert told["lease.given"] == {
        "acquisition": batch["id"],
        "count": 2,
        "strategy": "random",
        "labeler": "ada",
        "mode": "pool",
    }
    assert told["labels.accepted"] == {
        "count": 2,
        "first": 1,
        "watermark": 2,
        "by": "arm 3",
        "acquisition": batch["id"],
    }
    assert told["acquisition.labeled"] == {"acquisition": batch["id"]}


def test_a_job_goes_back_to_the_request_that_asked_for_it(on_both: Served) -> None:
    project, correlation = on_both.project(), uuid4().hex
    on_both.upload(project, room(0))
    body = {"project": project, "count": 1}
    assert on_both.client.post("/acquire", json=body, headers={ID: correlation}).status_code == 202
    on_both.drain()
    with on_both.services.database.read() as session:
        jobs = session.scalars(select(JobRow).where(JobRow.project_id == UUID(project))).all()
        assert {job.correlation for job in jobs} == {correlation}
        assert len(jobs) == 2  # the shard, and the merge that the shard's worker asked for
    told = [row for row in on_both.events(project) if row["kind"].startswith("job.")]
    assert {row["correlation"] for row in told} == {correlation}
    by = {(row["actor"] == "local", row["kind"]) for row in told}
    assert (True, "job.queued") in by
    assert (False, "job.done") in by
    assert {row["actor"] for row in told} == {"local", on_both.worker("score").owner}


def test_an_expired_lease_is_noted_once_and_a_revived_one_again(on_both: Served) -> None:
    project = on_both.project()
    on_both.upload(project, room(0))
    batch = on_both.acquire(project, 2, lease_seconds=60)

    def note() -> list[Json]:
        with on_both.services.database.write() as session:
            leases.note_expired(session, on_both.clock())
        return [row for row in on_both.events(project) if row["kind"] == "lease.expired"]

    assert note() == []
    on_both.clock.advance(61)
    (told,) = note()
    assert told["data"]["acquisition"] == batch["id"]
    assert note() == [told]
    assert on_both.get(f"/acquisitions/{batch['id']}")["status"] == "expired"
    lease = {"token": batch["token"], "lease_seconds": 60}
    assert on_both.client.post(f"/acquisitions/{batch['id']}/extend", json=lease).json()["status"] == "leased"
    assert note() == [told]
    on_both.clock.advance(61)
    assert len(note()) == 2
    assert on_both.label(project, answers(batch), batch).json()["created"] == 2
    assert on_both.get(f"/acquisitions/{batch['id']}")["status"] == "labeled"
    assert len(note()) == 2


def test_no_event_is_shown_before_an_older_one_that_is_not_committed(on_postgres: Served) -> None:
    project = on_postgres.project()
    seen = on_postgres.events(project)
    with on_postgres.services.database.write() as slow:
        events.record(slow, UUID(project), "slow", {}, on_postgres.clock())
        slow.flush()
        assert on_postgres.client.patch(f"/projects/{project}", json={"round_labels": 3}).status_code == 200
        assert on_postgres.get("/events", project=project)["items"] == seen
        newest = on_postgres.get("/events", project=project, newest=True)["items"]
        assert [row["kind"] for row in newest] == ["project.changed", *[row["kind"] for row in reversed(seen)]]
    after = on_postgres.events(project)
    assert after[: len(seen)] == seen
    assert [row["kind"] for row in after[len(seen) :]] == ["slow", "project.changed"]


def test_who_follows_events_misses_none_of_a_transaction_that_wrote_first_and_ends_last(on_postgres: Served) -> None:
    project, now = on_postgres.project(), on_postgres.clock()
    database = on_postgres.services.database
    with ExitStack() as begun_early:
        early = begun_early.enter_context(database.write())
        events.record(early, None, "begun", {}, now)
        early.flush()
        with database.write() as late:
            events.record(late, UUID(project), "late", {}, now)
            late.flush()
            events.record(early, UUID(project), "early", {}, now)  # its id is the larger one
            begun_early.close()
            newest = on_postgres.get("/events", project=project, newest=True, limit=1)["items"][0]
            first = on_postgres.events_up_to(project, newest["id"], limit=2)
            assert [row["kind"] for row in first["items"]] == ["project.created", "early"]
    assert first["next"] is None
    on_postgres.events(project)
    followed = on_postgres.get("/events", project=project, limit=2)
    assert followed["items"] == first["items"]
    rest = on_postgres.get("/events", project=project, cursor=followed["next"])["items"]
    assert [row["kind"] for row in rest] == ["late"]
    assert rest[0]["id"] < first["items"][1]["id"]


def test_events_go_on_in_order_when_another_server_has_counted_further(on_both: Served) -> None:
    project = on_both.project()
    database, url = on_both.services.database, on_both.services.settings.resolved_database_url()
    with database.write() as session:
        session.execute(update(EventRow).values(transaction=EventRow.transaction + 10**12))
    migrate(url)
    before = on_both.events(project)
    assert [row["kind"] for row in before] == ["project.created"]
    for round_labels in (3, 4):
        assert on_both.client.patch(f"/projects/{project}", json={"round_labels": round_labels}).status_code == 200
    on_both.events(project)
    page = on_both.get("/events", project=project, limit=1)
    assert page["items"] == before
    rest = on_both.get("/events", project=project, cursor=page["next"])["items"]
    assert [row["data"]["round_labels"] for row in rest] == [3, 4]


def test_labels_have_a_limit_of_their_own(start: Serve) -> None:
    served = start(max_labels_bytes=2000)
    project = served.project()
    (receipt,) = served.upload(project, room(0, 60))  # other bodies may be larger
    items = [{"trajectory": receipt["id"], "start": start, "actions": [0]} for start in range(60)]
    refused(served.label(project, items), 413, "body-too-large", 2000)
    whole = b'{"project": "%s", "items": []%s}' % (project.encode(), b" " * 2000)

    def chunks() -> Any:
        yield whole[:1000]
        yield whole[1000:]

    answer = served.client.post("/labels", content=chunks(), headers={"Content-Type": "application/json"})
    refused(answer, 413, "body-too-large", 2000)
    assert served.label(project, items[:10]).json()["created"] == 10
    assert served.show(project)["label_watermark"] == 10
