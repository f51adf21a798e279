"""Listings: every page in order, none twice, none left out, whatever joins in between; and cursors of our own only."""

import base64
import json
from typing import Any
from uuid import UUID

import pytest

from service import registry, rounds
from service.registry import TrainedModel
from service.store.tables import ProjectRow
from tests.service.kit import UNKNOWN, Json, Served, refused, room

LISTINGS = ("trajectories", "labels", "rounds", "models", "jobs", "events")


def busy(served: Served) -> str:
    """A project with seven of everything."""
    project = served.project()
    uploads = served.upload(project, *[room(seed, 1) for seed in range(7)])
    for upload in uploads:
        served.label(project, [{"trajectory": upload["id"], "start": 0, "actions": [0]}])
    with served.services.database.write() as session:
        row = session.get_one(ProjectRow, UUID(project))
        for number in range(7):
            current = rounds.request(session, row, served.clock())
            rounds.begin_training(session, current.id, served.clock())  # one that still waits would be given again
            model = TrainedModel("ensemble", number, "grid", {}, "0" * 64, 1, {})
            registry.register(session, row.id, current.id, model, 7, served.clock())
    return project


def walk(served: Served, listing: str, limit: int, **query: Any) -> list[Json]:
    """All items of a listing, page by page."""
    items: list[Json] = []
    cursor = None
    while True:
        page = served.get(f"/{listing}", limit=limit, **query, **({"cursor": cursor} if cursor else {}))
        assert len(page["items"]) <= limit
        items += page["items"]
        cursor = page["next"]
        if cursor is None:
            return items
        assert len(page["items"]) == limit


def test_pages_add_up_to_the_whole_listing(on_both: Served) -> None:
    project = busy(on_both)
    on_both.events(project)  # waits until all are listed
    for listing in LISTINGS:
        whole = walk(on_both, listing, 1000, project=project)
        assert len(whole) >= 7, listing
        for limit in (1, 3, len(whole), len(whole) - 1):
            assert walk(on_both, listing, limit, project=project) == whole, (listing, limit)


def test_pages_of_projects_add_up_too(served: Served) -> None:
    made = [served.project() for _ in range(5)]
    for limit in (1, 2, 5, 100):
        assert [row["id"] for row in walk(served, "projects", limit)] == made


def test_each_listing_has_its_order(served: Served) -> None:
    project = busy(served)
    listed = {listing: walk(served, listing, 1000, project=project) for listing in LISTINGS}
    assert [row["watermark"] for row in listed["labels"]] == list(range(1, 8))
    assert [row["number"] for row in listed["rounds"]] == list(range(7, 0, -1))
    for listing in ("models", "jobs"):
        times = [row["created_at"] for row in listed[listing]]
        assert times == sorted(times, reverse=True)
    ids = [row["id"] for row in listed["events"]]
    assert ids == sorted(set(ids))
    kinds = [row["kind"] for row in listed["events"]]
    assert kinds[:2] == ["project.created", "trajectory.added"]
    assert kinds.count("trajectory.added") == kinds.count("labels.accepted") == kinds.count("round.requested") == 7


def test_a_cursor_holds_its_place_while_rows_join(served: Served) -> None:
    project = served.project()
    first = [row["id"] for row in served.upload(project, *[room(seed, 1) for seed in range(4)])]
    page = served.get("/trajectories", project=project, limit=3)
    late = [row["id"] for row in served.upload(project, *[room(seed, 1) for seed in range(10, 13)])]
    rest = served.get("/trajectories", project=project, limit=10, cursor=page["next"])
    assert [row["id"] for row in page["items"] + rest["items"]] == first + late


def test_events_of_one_project_and_of_all(served: Served) -> None:
    one, other = served.project(), served.project()
    served.client.post("/keys", json={"name": "ada", "scopes": ["read"]})
    assert {row["project"] for row in served.get("/events", project=one)["items"]} == {one}
    everything = served.get("/events")["items"]
    assert [row["project"] for row in everything] == [one, other, None]
    assert [row["kind"] for row in everything] == ["project.created", "project.created", "key.created"]


def _cursor(*values: object) -> str:
    return base64.urlsafe_b64encode(json.dumps(values).encode()).decode()


@pytest.mark.parametrize(
    "cursor",
    [
        "",
        "nonsense",
        "é",
        base64.urlsafe_b64encode(b"{}").decode(),
        base64.urlsafe_b64encode(b"7").decode(),
        _cursor(),
        _cursor("x"),
        _cursor("x", "y"),
        _cursor(1, "x"),
        _cursor(None),
        _cursor([1]),
        _cursor({}, {}),
        _cursor(10**30),
        _cursor(float("inf")),
        _cursor("2026-01-01T00:00:00+00:00", 5),
        _cursor("2026-01-01T00:00:00+00:00", "5"),
        _cursor(1, 2, 3),
    ],
)
def test_a_cursor_that_we_did_not_give_out_is_refused(served: Served, cursor: str) -> None:
    project = served.project()
    for listing in ("projects", *LISTINGS):
        query = {"cursor": cursor} | ({} if listing == "projects" else {"project": project})
        refused(served.client.get(f"/{listing}", params=query), 422, "invalid-field", "cursor")


def test_a_listing_needs_a_project_that_is_there_and_a_sensible_limit(served: Served) -> None:
    for listing in LISTINGS:
        answer = served.client.get(f"/{listing}", params={"project": UNKNOWN})
        refused(answer, 404, "unknown-resource", UNKNOWN)
        for limit in (0, 1001, "many"):
            query = {"project": UNKNOWN, "limit": limit}
            refused(served.client.get(f"/{listing}", params=query), 422, "malformed-request", "limit")
