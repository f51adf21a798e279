"""Many at once: nothing twice, nothing lost, nobody turned away for the wrong reason."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from typing import Any, TypeVar
from uuid import UUID

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from service.store.tables import ClaimRow
from tests.service.kit import Json, Served, answers, npz, room, segments
from tests.service.test_labels import labeled

R = TypeVar("R")
CLIENTS = 16


def at_once(served: Served, clients: int, work: Callable[[int, TestClient], R]) -> list[R]:
    """Every client's work, begun at one moment."""
    together = Barrier(clients)

    def run(number: int) -> R:
        client = served.another_client()
        together.wait(timeout=30)
        return work(number, client)

    with ThreadPoolExecutor(clients) as threads:
        return list(threads.map(run, range(clients)))


def ready(served: Served, segment_count: int, **fields: Any) -> str:
    """A project of so many segments, all in a queue."""
    project = served.project(**fields)
    served.upload(project, *[room(seed, segment_count // 4) for seed in range(4)])
    assert served.ask(project).status_code == 202
    served.drain()
    return project


def post(client: TestClient, path: str, **body: Any) -> Json:
    answer = client.post(path, json=body)
    assert answer.status_code in (200, 201), answer.text
    return dict(answer.json())


def test_sixteen_at_once_drain_the_pool_and_share_nothing(on_both: Served) -> None:
    project = ready(on_both, 160)

    def take(_: int, client: TestClient) -> list[Json]:
        return [post(client, "/acquire", project=project, count=2) for _ in range(5)]

    batches = [batch for taken in at_once(on_both, CLIENTS, take) for batch in taken]
    offered = [segment for batch in batches for segment in segments(batch)]
    assert len(set(offered)) == len(offered) == 160
    assert {batch["reason"] for batch in batches} == {None}
    assert len({batch["token"] for batch in batches}) == 80
    counts = on_both.show(project)["counts"]
    assert (counts["leased"], counts["unlabeled"]) == (160, 0)


def test_sixteen_at_once_never_spend_more_than_the_budget(on_both: Served) -> None:
    project = ready(on_both, 160, policy={"label_budget": 41})

    def take(_: int, client: TestClient) -> list[Json]:
        given = [client.post("/acquire", json={"project": project, "count": 3}) for _ in range(2)]
        assert {answer.status_code for answer in given} <= {201, 409}
        return [answer.json() for answer in given if answer.status_code == 201]

    batches = [batch for taken in at_once(on_both, CLIENTS, take) for batch in taken]
    assert sorted(len(batch["items"]) for batch in batches) == [2] + [3] * 13
    assert on_both.show(project)["budget"] == {"total": 41, "spent": 0, "reserved": 41, "remaining": 0}


def test_batches_are_given_while_others_label_and_give_back(on_both: Served) -> None:
    """Each client labels two of three and gives one back; what is given back is given to others."""
    project = ready(on_both, 120)

    def work(number: int, client: TestClient) -> list[tuple[str, int]]:
        mine = []
        for _ in range(6):
            batch = post(client, "/acquire", project=project, count=3)
            assert len(batch["items"]) == 3
            lease = {"acquisition": batch["id"], "token": batch["token"]}
            items = answers(batch, number % 7)[:2]
            assert post(client, "/labels", project=project, items=items, **lease)["created"] == 2
            post(client, f"/acquisitions/{batch['id']}/release", token=batch["token"])
            mine += [(item["trajectory"], item["start"]) for item in items]
        return mine

    done = [segment for mine in at_once(on_both, 8, work) for segment in mine]
    rows = on_both.get("/labels", project=project, limit=1000)["items"]
    assert sorted(done) == sorted((row["trajectory"], row["start"]) for row in rows)
    assert len(set(done)) == len(done) == 96
    assert [row["watermark"] for row in rows] == list(range(1, 97))
    counts = on_both.show(project)["counts"]
    assert (counts["leased"], counts["labeled"], counts["unlabeled"]) == (0, 96, 24)
    with on_both.services.database.read() as session:
        assert session.scalars(select(ClaimRow).where(ClaimRow.project_id == UUID(project))).all() == []


def test_labels_of_many_writers_leave_no_gap_in_the_watermark(on_both: Served) -> None:
    project = on_both.project()
    receipts = on_both.upload(project, *[room(seed, 20) for seed in range(8)])

    def write(number: int, client: TestClient) -> list[int]:
        name = receipts[number]["id"]
        items = [{"trajectory": name, "start": start, "actions": [0]} for start in range(20)]
        return [post(client, "/labels", project=project, items=items[i : i + 4])["watermark"] for i in range(0, 20, 4)]

    marks = sorted(mark for mine in at_once(on_both, 8, write) for mark in mine)
    assert marks == list(range(4, 161, 4))
    rows = on_both.get("/labels", project=project, limit=1000)["items"]
    assert [row["watermark"] for row in rows] == list(range(1, 161))


@pytest.mark.parametrize("path", ["/labels", "/trajectories"])
def test_two_projects_given_the_same_trajectories_in_opposite_order_both_get_them(on_both: Served, path: str) -> None:
    projects = [on_both.project(), on_both.project()]

    def write(number: int, client: TestClient) -> set[int]:
        statuses = set()
        for turn in range(5):
            contents = [room(1000 * (path == "/labels") + 100 * turn + seed + 7000) for seed in range(12)]
            contents = contents[::-1] if number else contents
            if path == "/labels":
                uploads = [labeled(arrays, [0] * 5) for arrays in contents]
                answer = client.post(path, json={"project": projects[number], "trajectories": uploads})
            else:
                files = [("files", (f"{i}.npz", npz(arrays))) for i, arrays in enumerate(contents)]
                answer = client.post(path, params={"project": projects[number]}, files=files)
            statuses.add(answer.status_code)
        return statuses

    assert at_once(on_both, 2, write) == [{201}, {201}]
    for project in projects:
        counts = on_both.show(project)["counts"]
        assert counts["pool_trajectories"] == 60
        assert counts["labeled"] == (300 if path == "/labels" else 0)
