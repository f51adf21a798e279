"""A project that goes on while work is under way: rounds overtake, the pool grows, values are bounded."""

from uuid import UUID

import numpy as np

from service import rounds
from service.store.queries.rounds import queued_rounds
from tests.service.kit import Served, answers, npz, refused, room, segments
from tests.service.test_rounds import labeled, requested


def test_a_round_asked_for_twice_on_the_same_labels_is_one(on_both: Served) -> None:
    project = labeled(on_both)
    assert requested(on_both, project) == requested(on_both, project)


def test_a_round_that_still_waits_gives_way_to_one_on_newer_labels(on_both: Served) -> None:
    project = labeled(on_both)
    first = requested(on_both, project)
    batch = on_both.acquire(project, 2)
    assert on_both.label(project, answers(batch), batch).status_code == 201
    second = requested(on_both, project)
    assert on_both.get(f"/rounds/{first}")["status"] == "superseded"
    with on_both.services.database.read() as session:
        assert [row.id for row in queued_rounds(session, UUID(project))] == [second]


def test_a_failed_round_makes_its_labels_due_again(served: Served) -> None:
    project = served.project(policy={"round_labels": 3})
    served.upload(project, room(0), room(1))
    batch = served.acquire(project, 3)
    first = UUID(served.label(project, answers(batch), batch).json()["round"])
    with served.services.database.write() as session:
        rounds.begin_training(session, first, served.clock())
        rounds.fail(session, first, "the disk was full", served.clock())
    batch = served.acquire(project, 1)
    assert served.label(project, answers(batch), batch).json()["round"] is not None


def test_a_queue_that_is_ready_serves_while_the_pool_grows(on_both: Served) -> None:
    project = on_both.project()
    on_both.upload(project, room(0, 20))
    on_both.acquire(project, 1)
    for seed in range(1, 4):
        on_both.upload(project, room(seed, 20))
        assert on_both.ask(project, 1).status_code == 201


def test_random_stays_uniform_when_the_pool_has_grown(served: Served) -> None:
    project = served.project()
    old = {receipt["id"] for receipt in served.upload(project, *[room(seed, 50) for seed in range(4)])}
    first = served.acquire(project, 100)
    assert served.label(project, answers(first), first).status_code == 201
    served.upload(project, *[room(seed, 50) for seed in range(4, 8)])
    served.ask(project, 1)
    served.drain()
    drawn = [trajectory in old for trajectory, _ in segments(served.acquire(project, 120))]
    assert 20 < sum(drawn) < 60  # 100 old and 200 new segments are free: 40 expected, standard deviation 4


def test_a_value_beyond_the_vocabulary_is_refused_with_its_place(served: Served) -> None:
    project = served.project()
    broken = room(0)
    broken["grid"][2, 3, 1, 0] = 200
    answer = served.send(project, [("broken.npz", npz(broken))])
    refused(answer, 422, "invalid-trajectory", "broken.npz", "[2, 3, 1, 0]", 200)
    own = {"spaces": {"observations": _streams(), "actions": {"kind": "discrete", "n": 7}}}
    by_hand = served.project(environment=own)
    refused(served.send(by_hand, [("broken.npz", npz(broken))]), 422, "invalid-trajectory", 200)


def test_spaces_that_no_family_takes_hold_labels_but_train_nothing(served: Served) -> None:
    spaces = {"observations": {"height": {"dtype": "float32", "shape": [1]}}, "actions": {"kind": "discrete", "n": 2}}
    project = served.project(environment={"spaces": spaces}, policy={"round_labels": 1})
    assert served.show(project)["family"] is None
    served.upload(project, {"height": np.zeros((4, 1), np.float32)})
    batch = served.acquire(project, 2)
    answer = served.label(project, answers(batch), batch)
    assert (answer.status_code, answer.json()["round"]) == (201, None)
    refused(served.client.post("/rounds", json={"project": project}), 409, "no-model-family", project)
    body = {"name": "wrong", "environment": {"spaces": spaces}, "family": "grid"}
    refused(served.client.post("/projects", json=body), 422, "malformed-request", "grid")


def test_uploads_without_a_lease_stay_within_the_budget(served: Served) -> None:
    project = served.project(policy={"label_budget": 3})
    receipt = served.upload(project, room(0, 8))[0]
    items = [{"trajectory": receipt["id"], "start": start, "actions": [0]} for start in range(4)]
    refused(served.label(project, items), 409, "budget-exhausted", 4, 3)
    assert served.show(project)["budget"]["spent"] == 0
    assert served.label(project, items[:3]).status_code == 201


def _streams() -> dict[str, object]:
    return {"grid": {"dtype": "uint8", "shape": [6, 6, 3]}, "carried": {"dtype": "uint8", "shape": [3]}}
