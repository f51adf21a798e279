"""Late answers, the budget, explorations, and the sweep of expired leases."""

import base64
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from httpx2 import Response
from sqlalchemy import text

from api_schemas.jobs import TrainSubgoalGenerator
from service import jobs, leases, projects
from tests.service.kit import Arrays, Json, Served, answers, npz, refused, room, segments

LENGTH = 2
POLE: Json = {
    "spaces": {
        "observations": {"angle": {"dtype": "float32", "shape": [1]}},
        "actions": {"kind": "discrete", "n": 3},
    }
}
ARM: Json = {
    "spaces": {
        "observations": {"angle": {"dtype": "float32", "shape": [1]}},
        "actions": {"kind": "box", "shape": [2, 2], "low": -0.5, "high": 2.0},
    }
}


def pole(number: int, transitions: int = LENGTH) -> Arrays:
    return {"angle": np.random.default_rng(number).normal(size=(transitions + 1, 1)).astype(np.float32)}


def exploring(served: Served, environment: Json = POLE, **policy: Any) -> str:
    """A project with three trajectories of four segments each; no simulator, so any state can be gone back to."""
    project = served.project(environment=environment, segment_length=LENGTH, policy=policy)
    served.upload(project, *[pole(number, 8) for number in range(3)])
    return project


def explore(served: Served, project: str, count: int, **fields: Any) -> Json:
    answer = served.ask(project, count, mode="explore", **fields)
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def report(served: Served, batch: Json, rank: int, number: int, actions: Any = (0, 1), **fields: Any) -> Response:
    """What came of an exploration: trajectory `number`."""
    content = base64.b64encode(npz(pole(number, len(actions)))).decode()
    trajectory = {"content": content, "actions": actions, "rank": rank} | fields
    return served.label(batch["project"], [], batch, trajectories=[trajectory])


def change(served: Served, batch: Json, what: str, **fields: Any) -> Response:
    return served.client.post(f"/acquisitions/{batch['id']}/{what}", json={"token": batch["token"]} | fields)


def grid(served: Served, budget: int) -> tuple[str, list[Json]]:
    """A project of ten segments, and a label for each."""
    project = served.project(policy={"label_budget": budget})
    receipts = served.upload(project, room(0), room(1))
    return project, [{"trajectory": each["id"], "start": n, "actions": [0]} for each in receipts for n in range(5)]


def test_a_late_label_that_would_overshoot_the_budget_stores_nothing(on_both: Served) -> None:
    project, items = grid(on_both, budget=3)
    late = on_both.acquire(project, 3, lease_seconds=60)
    on_both.clock.advance(61)
    others = [item for item in items if (item["trajectory"], item["start"]) not in segments(late)]
    assert on_both.label(project, others[:2]).status_code == 201
    before = on_both.show(project)
    refused(on_both.label(project, answers(late), late), 409, "budget-exhausted", 3, "1 of the budget of 3")
    assert on_both.show(project) == before
    assert on_both.label(project, answers(late)[:1], late).json()["created"] == 1
    refused(on_both.label(project, answers(late)[1:2], late), 409, "budget-exhausted", "0 of the budget of 3")
    assert on_both.label(project, answers(late)[:1], late).json()["duplicates"] == 1


def test_an_expired_lease_needs_room_in_the_budget_to_go_on(on_both: Served) -> None:
    project, items = grid(on_both, budget=3)
    batch = on_both.acquire(project, 3, lease_seconds=60)
    assert change(on_both, batch, "extend", lease_seconds=60).status_code == 200  # it is reserved already
    on_both.clock.advance(61)
    others = [item for item in items if (item["trajectory"], item["start"]) not in segments(batch)]
    assert on_both.label(project, others[:1]).status_code == 201
    refused(change(on_both, batch, "extend"), 409, "budget-exhausted", "2 of the budget of 3")
    shown = on_both.get(f"/acquisitions/{batch['id']}")
    assert (shown["status"], on_both.show(project)["counts"]["leased"]) == ("expired", 0)
    assert on_both.client.patch(f"/projects/{project}", json={"label_budget": 4}).status_code == 200
    assert change(on_both, batch, "extend").json()["status"] == "leased"
    assert on_both.show(project)["budget"] == {"total": 4, "spent": 1, "reserved": 3, "remaining": 0}


def test_what_is_reserved_is_honoured_after_the_budget_was_lowered(on_both: Served) -> None:
    project = exploring(on_both, label_budget=8)
    batch, states = on_both.acquire(project, 3, strategy="random"), explore(on_both, project, 3)
    assert on_both.client.patch(f"/projects/{project}", json={"label_budget": 2}).status_code == 200
    refused(on_both.ask(project, 1, mode="explore"), 409, "budget-exhausted", "0 of the budget of 2")
    assert on_both.label(project, answers(batch), batch).json()["created"] == 3
    assert report(on_both, states, 0, 100).json()["created"] == 1
    more = report(on_both, states, 1, 101, actions=(0, 1, 0, 1))  # two labels, one was reserved
    refused(more, 409, "budget-exhausted")
    assert change(on_both, states, "extend", lease_seconds=60).status_code == 200
    on_both.clock.advance(61)
    refused(report(on_both, states, 1, 101), 409, "budget-exhausted")
    assert on_both.show(project)["budget"] == {"total": 2, "spent": 4, "reserved": 0, "remaining": 0}


def test_an_exploration_is_answered_by_a_new_trajectory_born_labeled(on_both: Served) -> None:
    project = exploring(on_both)
    pool = {receipt["id"] for receipt in on_both.get("/trajectories", project=project)["items"]}
    batch = explore(on_both, project, 2, labeler="arm 3")
    assert (batch["mode"], batch["purpose"], batch["strategy"], batch["round"]) == ("explore", "pool", "random", None)
    for rank, item in enumerate(batch["items"]):
        assert (item["rank"], item["length"], item["score"], item["labeled"]) == (rank, LENGTH, None, False)
        assert item["trajectory"] in pool
        assert item["start"] in range(0, 8, LENGTH)
        assert len(item["actions"]) == LENGTH
        assert set(item["actions"]) <= {0, 1, 2}
    before = on_both.show(project)
    assert (before["counts"]["leased"], before["budget"]["reserved"]) == (0, 2)  # it holds no segment, only budget
    accepted = report(on_both, batch, 1, 100)
    assert accepted.json()["created"] == 1
    new = accepted.json()["receipts"][0]["trajectory"]
    shown = on_both.get(f"/acquisitions/{batch['id']}")
    assert ([item["labeled"] for item in shown["items"]], shown["status"]) == ([False, True], "leased")
    (label,) = on_both.get("/labels", project=project)["items"]
    assert (label["trajectory"], label["actions"], label["acquisition"]) == (new, [0, 1], batch["id"])
    assert on_both.show(project)["counts"]["pool_trajectories"] == 4
    assert on_both.show(project)["budget"] == {"total": None, "spent": 1, "reserved": 1, "remaining": None}
    assert report(on_both, batch, 0, 101).status_code == 201
    assert on_both.get(f"/acquisitions/{batch['id']}")["status"] == "labeled"


def test_an_exploration_is_answered_once(on_both: Served) -> None:
    project = exploring(on_both)
    batch = explore(on_both, project, 2)
    assert report(on_both, batch, 0, 100).json()["created"] == 1
    assert report(on_both, batch, 0, 100).json()["duplicates"] == 1
    before = on_both.show(project)
    refused(report(on_both, batch, 0, 101), 410, "lease-lost", batch["id"], "answered")
    refused(report(on_both, batch, 0, 100, actions=(1, 1)), 409, "label-conflict", "[0, 1]", "[1, 1]")
    refused(report(on_both, batch, 2, 101), 422, "invalid-field", "trajectories[0].rank", 2)
    refused(report(on_both, batch | {"token": 0}, 1, 101), 403, "invalid-lease-token", batch["id"])
    alone = {"content": base64.b64encode(npz(pole(101))).decode(), "actions": [0, 1], "rank": 1}
    refused(on_both.label(project, [], trajectories=[alone]), 422, "invalid-field", "needs the acquisition")
    given = on_both.acquire(project, 1, strategy="random")
    refused(report(on_both, given, 0, 101), 422, "invalid-field", "is no exploration")
    assert change(on_both, batch, "release").json()["status"] == "released"
    refused(report(on_both, batch, 1, 101), 410, "lease-lost", "given back")
    counts = on_both.show(project)["counts"]
    assert (counts["pool_trajectories"], counts["labeled"]) == (4, 1) == (before["counts"]["pool_trajectories"], 1)


def test_an_exploration_may_be_answered_late(served: Served) -> None:
    project = exploring(served, label_budget=2)
    batch = explore(served, project, 2, lease_seconds=60)
    served.clock.advance(61)
    assert report(served, batch, 0, 100).json()["created"] == 1
    other = explore(served, project, 2)
    assert (len(other["items"]), other["reason"]) == (1, "2 were asked for, 1 of the budget of 2 labels remain")
    refused(report(served, batch, 1, 101), 409, "budget-exhausted")
    assert report(served, other, 0, 101).json()["created"] == 1


def test_a_robots_explorations_are_within_its_action_space(served: Served) -> None:
    project = exploring(served, environment=ARM)
    actions = np.array([item["actions"] for item in explore(served, project, 50)["items"]])
    assert actions.shape == (50, LENGTH, 4)
    assert actions.min() >= -0.5
    assert actions.max() <= 2.0
    assert actions.std() > 0.6  # 2.5 / sqrt(12) = 0.72


def test_explorations_are_drawn_from_all_of_the_pool_by_chance_alone(served: Served) -> None:
    project = exploring(served)
    batch = explore(served, project, 400)
    drawn = segments(batch)
    assert len(set(drawn)) == 12
    assert max(drawn.count(segment) for segment in set(drawn)) < 65  # 33 expected, standard deviation 5.5
    assert len({tuple(item["actions"]) for item in batch["items"]}) == 9
    assert segments(explore(served, project, 400)) != drawn


def test_where_nothing_can_be_gone_back_to_nothing_is_explored(served: Served) -> None:
    project = served.project()  # a simulator's, whose states are not kept
    served.upload(project, room(0))
    refused(served.ask(project, 1, mode="explore"), 409, "nothing-to-explore", "minigrid")
    body = {"mode": "explore", "purpose": "held_out"}
    refused(served.ask(project, 1, **body), 422, "malformed-request", "held_out")


def test_an_exploration_brings_at_least_one_label(served: Served) -> None:
    project = exploring(served)
    batch = explore(served, project, 1)
    refused(report(served, batch, 0, 100, starts=[]), 422, "invalid-label", "starts", 0, "at least 1")
    assert served.show(project)["counts"]["pool_trajectories"] == 3
    assert report(served, batch, 0, 100).json()["created"] == 1


def test_a_trajectory_that_nobody_asked_for_needs_no_lease_beside_one_that_has_it(served: Served) -> None:
    project = exploring(served)
    batch = served.acquire(project, 1, strategy="random")
    own = {"content": base64.b64encode(npz(pole(100))).decode(), "actions": [0, 1]}
    answer = served.label(project, answers(batch), batch, trajectories=[own])
    assert (answer.status_code, answer.json()["created"]) == (201, 2), answer.text
    assert served.get(f"/acquisitions/{batch['id']}")["status"] == "labeled"


def test_what_an_exploration_brings_is_never_held_out(served: Served) -> None:
    batch = explore(served, exploring(served), 1)
    refused(report(served, batch, 0, 100, split="held_out"), 422, "malformed-request", "split", "held_out")


@pytest.mark.parametrize("what", ["extend", "release"])
def test_the_sweep_of_expired_leases_undoes_nothing_that_its_holder_does_meanwhile(
    on_postgres: Served, what: str
) -> None:
    project = on_postgres.project()
    on_postgres.upload(project, room(0))
    batch = on_postgres.acquire(project, 2, lease_seconds=60)
    on_postgres.clock.advance(61)
    with ThreadPoolExecutor(1) as threads:
        with on_postgres.services.database.write() as sweep:
            leases.note_expired(sweep, on_postgres.clock())
            sweep.flush()
            meanwhile = threads.submit(change, on_postgres, batch, what)
            _until_somebody_waits(on_postgres)
        assert meanwhile.result(timeout=20).status_code == 200
    shown = on_postgres.get(f"/acquisitions/{batch['id']}")
    assert shown["status"] == {"extend": "leased", "release": "released"}[what]


def test_a_lease_that_ends_while_another_waits_for_the_project_counts_as_ended(on_postgres: Served) -> None:
    project = on_postgres.project()
    on_postgres.upload(project, room(0, 1))
    first = on_postgres.acquire(project, 1, lease_seconds=60)
    with ThreadPoolExecutor(1) as threads:
        with on_postgres.services.database.write() as session:
            projects.find(session, UUID(project), lock=True)
            meanwhile = threads.submit(on_postgres.ask, project)
            _until_somebody_waits(on_postgres)
            on_postgres.clock.advance(61)
        answer = meanwhile.result(timeout=20)
    assert answer.status_code == 201, answer.text
    assert segments(answer.json()) == segments(first)
    lease = {"token": first["token"], "lease_seconds": 60}
    refused(on_postgres.client.post(f"/acquisitions/{first['id']}/extend", json=lease), 410, "lease-lost")


def test_a_lease_that_was_shortened_hides_its_segments_no_longer_than_it_lasts(on_both: Served) -> None:
    project = on_both.project()
    on_both.upload(project, room(0))
    first = on_both.acquire(project, 2, lease_seconds=86400)
    lease = {"token": first["token"], "lease_seconds": 60}
    assert on_both.client.post(f"/acquisitions/{first['id']}/extend", json=lease).status_code == 200
    on_both.clock.advance(61)
    assert segments(on_both.acquire(project, 2)) == segments(first)


def test_rows_that_refer_to_a_locked_project_are_written_all_the_same(on_postgres: Served) -> None:
    project = UUID(on_postgres.project())
    with on_postgres.services.database.write() as session:
        projects.find(session, project, lock=True)
        with on_postgres.services.database.write() as other:
            other.connection().exec_driver_sql("SET LOCAL lock_timeout = 2000")
            jobs.enqueue(other, project, TrainSubgoalGenerator(project=project), project, on_postgres.clock())


def _until_somebody_waits(served: Served) -> None:
    """Another transaction of this database waits for a lock."""
    query = text(
        "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND wait_event_type = 'Lock'"
    )
    deadline = time.monotonic() + 15
    while time.monotonic() < deadline:
        with served.services.database.engine.connect() as connection:
            if connection.scalar(query):
                return
    raise AssertionError("nobody waits for a lock")
