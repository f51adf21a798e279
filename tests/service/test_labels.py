"""Labels are checked against space, segment and lease, accepted once, all of a request or none, and never changed."""

import base64
import json
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.service.kit import ROBOT, UNKNOWN, Arrays, Json, Served, answers, npz, refused, robot, room


def filled(served: Served, trajectories: int = 2, **fields: Any) -> str:
    """A project with five segments a trajectory."""
    project = served.project(**fields)
    served.upload(project, *[room(seed) for seed in range(trajectories)])
    return project


def free(served: Served, project: str) -> list[Json]:
    """A label for every segment of every trajectory, no lease asked for."""
    trajectories = served.get("/trajectories", project=project)["items"]
    return [
        {"trajectory": trajectory["id"], "start": start, "actions": [0]}
        for trajectory in trajectories
        for start in range(trajectory["segments"])
    ]


def labeled(arrays: Arrays, actions: list[Any], **fields: Any) -> Json:
    """A whole trajectory with its actions."""
    return {"content": base64.b64encode(npz(arrays)).decode(), "actions": actions} | fields


def stored(served: Served, project: str) -> list[Json]:
    return list(served.get("/labels", project=project)["items"])


def test_a_batch_is_labeled_under_its_lease(on_both: Served) -> None:
    project = filled(on_both)
    batch = on_both.acquire(project, 4)
    source = {"kind": "simulator", "name": "minigrid"}
    items = [item | {"residual": 0.25, "action_sets": [[0, 1]]} for item in answers(batch)]
    accepted = on_both.label(project, items, batch, source=source)
    assert accepted.status_code == 201
    assert accepted.json() | {"receipts": None} == {
        "receipts": None,
        "created": 4,
        "duplicates": 0,
        "watermark": 4,
        "round": None,
    }
    keys = [(item["trajectory"], item["start"]) for item in items]
    assert [(receipt["trajectory"], receipt["start"]) for receipt in accepted.json()["receipts"]] == keys
    assert {(r["status"], r["split"]) for r in accepted.json()["receipts"]} == {("created", "pool")}
    shown = on_both.get(f"/acquisitions/{batch['id']}")
    assert (shown["status"], {item["labeled"] for item in shown["items"]}) == ("labeled", {True})
    rows = stored(on_both, project)
    assert [(row["trajectory"], row["start"]) for row in rows] == keys
    assert [row["watermark"] for row in rows] == [1, 2, 3, 4]
    for row in rows:
        assert (row["actions"], row["action_sets"], row["residual"]) == ([0], [[0, 1]], 0.25)
        assert (row["acquisition"], row["source"], row["split"]) == (batch["id"], source, "pool")
    assert on_both.show(project)["label_watermark"] == 4


def test_a_free_segment_needs_no_lease(served: Served) -> None:
    project = filled(served)
    assert served.label(project, free(served, project)[:3]).json()["created"] == 3
    assert served.show(project)["counts"]["labeled"] == 3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"actions": [7]}, ["actions[0]", "0 to 6", 7]),
        ({"actions": [-1]}, ["actions[0]", -1]),
        ({"actions": [10**15]}, ["actions[0]", 10**15]),
        ({"actions": [[0.5]]}, ["actions[0]", "[0.5]"]),
        ({"actions": [1, 2]}, ["length", "must be 1", 2]),
        ({"start": 5}, ["start", "up to 4", 5]),
        ({"start": 10**15}, ["start", 10**15]),
        ({"action_sets": [[0], [1]]}, ["action_sets", "must be 1", 2]),
        ({"action_sets": [[1, 2]]}, ["action_sets[0]", "must hold the action 0"]),
        ({"action_sets": [[0, 7]]}, ["action_sets[0]", 7]),
    ],
)
def test_one_label_that_does_not_fit_leaves_nothing_of_ten(served: Served, change: Json, words: list[object]) -> None:
    project = filled(served)
    items = free(served, project)
    items[6] |= change
    before = served.show(project)
    refused(served.label(project, items), 422, "invalid-label", items[6]["trajectory"], *words)
    assert served.show(project) == before
    assert stored(served, project) == []


@pytest.mark.parametrize("action", ["true", "1.5", "1e30", '"1"', "null", "[]", "{}"])
def test_a_discrete_action_is_an_integer_and_nothing_like_it(served: Served, action: str) -> None:
    project = filled(served)
    item = free(served, project)[0]
    body = json.dumps({"project": project, "items": [item]}).replace('"actions": [0]', f'"actions": [{action}]')
    answer = served.client.post("/labels", content=body, headers={"Content-Type": "application/json"})
    refused(answer, 422, "invalid-label" if action == "[]" else "malformed-request", "actions")
    assert stored(served, project) == []


def test_a_robots_actions_are_checked_number_by_number(served: Served) -> None:
    project = served.project(environment=ROBOT, segment_length=4)
    (trajectory,) = served.upload(project, robot(0, transitions=11))
    good = [[0.1 * joint for joint in range(7)]] * 4
    item = {"trajectory": trajectory["id"], "start": 4, "actions": good}

    def changed(action: object) -> Json:
        return item | {"actions": [*good[:2], action, good[3]]}

    for action, words in [
        ([0.0] * 6, "must be 7 numbers"),
        (3, "must be 7 numbers"),
        ([0.0] * 6 + [1.01], "-1.0 to 1.0"),
    ]:
        refused(served.label(project, [changed(action)]), 422, "invalid-label", "actions[2]", words, action)
    refused(served.label(project, [item | {"actions": good[:3]}]), 422, "invalid-label", "length", "must be 4", 3)
    refused(served.label(project, [item | {"start": 2}]), 422, "invalid-label", "multiple of 4 up to 4", 2)
    refused(served.label(project, [item | {"start": 8}]), 422, "invalid-label", "multiple of 4 up to 4", 8)
    refused(served.label(project, [item | {"action_sets": [[0]] * 4}]), 422, "invalid-label", "discrete")
    for number in ("NaN", "Infinity", "-Infinity", "1e999"):
        body = json.dumps({"project": project, "items": [item]}).replace("0.1,", f"{number},")
        answer = served.client.post("/labels", content=body, headers={"Content-Type": "application/json"})
        refused(answer, 422, "malformed-request", "actions")
    assert stored(served, project) == []
    assert served.label(project, [item]).json()["created"] == 1
    assert stored(served, project)[0]["actions"] == good


def test_the_whole_loop_of_acquire_and_label_holds_for_a_robot(served: Served) -> None:
    project = served.project(environment=ROBOT, segment_length=4, policy={"strategy": "random"})
    served.upload(project, robot(0, 11), robot(1, 8))
    assert served.show(project)["counts"]["pool_segments"] == 4
    batch = served.acquire(project, 3)
    assert {item["length"] for item in batch["items"]} == {4}
    assert {item["start"] % 4 for item in batch["items"]} == {0}
    assert served.label(project, answers(batch, [0.5] * 7), batch).json()["created"] == 3
    assert served.show(project)["counts"]["labeled"] == 3


def test_a_second_different_label_is_refused_and_shows_both(on_both: Served) -> None:
    project = filled(on_both)
    item = free(on_both, project)[0]
    assert on_both.label(project, [item | {"actions": [2]}]).status_code == 201
    others = [item | {"actions": [5]}, item | {"actions": [2], "action_sets": [[2, 5]]}]
    for other in others:
        shown = other.get("action_sets") or other["actions"]
        refused(on_both.label(project, [other]), 409, "label-conflict", item["trajectory"], "[2]", shown)
    assert [row["actions"] for row in stored(on_both, project)] == [[2]]


def test_the_same_label_again_is_a_duplicate(on_both: Served) -> None:
    project = filled(on_both)
    batch = on_both.acquire(project, 3)
    assert on_both.label(project, answers(batch), batch).json()["created"] == 3
    for again in (on_both.label(project, answers(batch), batch), on_both.label(project, answers(batch))):
        assert again.status_code == 201
        assert (again.json()["created"], again.json()["duplicates"], again.json()["watermark"]) == (0, 3, 3)
    twice = free(on_both, project)
    items = [item for item in twice if item not in answers(batch)][:1] * 2
    accepted = on_both.label(project, items).json()
    assert [receipt["status"] for receipt in accepted["receipts"]] == ["created", "duplicate"]


def test_another_action_of_the_same_set_is_the_same_label(served: Served) -> None:
    project = filled(served)
    item = free(served, project)[0]
    first = item | {"actions": [3], "action_sets": [[3, 4, 5]], "residual": 0.0}
    again = item | {"actions": [5], "action_sets": [[5, 3, 4, 3]], "residual": None}
    assert served.label(project, [first]).json()["created"] == 1
    assert served.label(project, [again]).json()["duplicates"] == 1
    alone, in_a_set = item | {"start": 1, "actions": [6]}, item | {"start": 1, "actions": [6], "action_sets": [[6]]}
    assert served.label(project, [alone]).json()["created"] == 1
    assert served.label(project, [in_a_set]).json()["duplicates"] == 1
    assert [row["actions"] for row in stored(served, project)] == [[3], [6]]


def test_a_lease_is_answered_with_its_token(on_both: Served) -> None:
    project = filled(on_both)
    batch, other = on_both.acquire(project, 2), on_both.acquire(project, 2)
    for token in (None, batch["token"] + 1, other["token"], -1):
        answer = on_both.label(project, answers(batch), batch | {"token": token})
        refused(answer, 403, "invalid-lease-token", batch["id"])
    refused(on_both.label(project, answers(batch)), 423, "segment-leased", batch["items"][0]["trajectory"])
    refused(on_both.label(project, answers(batch), other), 410, "lease-lost", other["id"])
    refused(on_both.label(project, answers(batch), token=1), 422, "invalid-field", "token")
    refused(on_both.label(project, answers(batch), batch | {"id": UNKNOWN}), 404, "unknown-resource", UNKNOWN)
    foreign = filled(on_both)
    refused(on_both.label(foreign, answers(batch), batch), 404, "unknown-resource", batch["id"])
    assert stored(on_both, project) == []
    assert on_both.label(project, answers(batch), batch).status_code == 201


def test_a_late_label_counts_until_another_holds_the_segment(on_both: Served) -> None:
    project = filled(on_both)
    late = on_both.acquire(project, 10, lease_seconds=60)
    on_both.clock.advance(61)
    assert on_both.label(project, answers(late)[:3], late).json()["created"] == 3
    taken = on_both.acquire(project, 2)
    mine = {(item["trajectory"], item["start"]) for item in taken["items"]}
    lost = [item for item in answers(late) if (item["trajectory"], item["start"]) in mine]
    kept = [item for item in answers(late)[3:] if item not in lost]
    refused(on_both.label(project, [*kept, *lost], late), 410, "lease-lost", late["id"], lost[0]["trajectory"])
    assert len(stored(on_both, project)) == 3
    assert on_both.label(project, kept, late).json()["created"] == 5
    assert on_both.label(project, answers(taken), taken).json()["created"] == 2


def test_an_expired_segment_takes_a_label_from_anybody(served: Served) -> None:
    project = filled(served)
    batch = served.acquire(project, 1, lease_seconds=60)
    refused(served.label(project, answers(batch)), 423, "segment-leased")
    served.clock.advance(61)
    assert served.label(project, answers(batch)).json()["created"] == 1
    assert served.label(project, answers(batch), batch).json()["duplicates"] == 1


def test_labels_name_a_trajectory_of_the_project(served: Served) -> None:
    project, other = filled(served), served.project()
    item = free(served, project)[0]
    refused(served.label(UNKNOWN, [item]), 404, "unknown-resource", UNKNOWN)
    refused(served.label(other, [item]), 404, "unknown-resource", item["trajectory"], other)
    refused(served.label(project, [item | {"trajectory": "f" * 64}]), 404, "unknown-resource", "f" * 64)
    refused(served.label(project, [item | {"trajectory": "../x"}]), 422, "malformed-request", "trajectory")
    refused(served.label(project, []), 422, "invalid-field", "items")


def test_every_hundred_labels_of_the_pool_start_one_round(served: Served) -> None:
    project = served.project(policy={"round_labels": 4, "strategy": "random"})
    served.upload(project, *[room(seed, 8) for seed in range(2)])
    held_out = [served.upload(project, room(100, 8), split="held_out")[0]["id"]]
    items = [item for item in free(served, project) if item["trajectory"] not in held_out]
    tests = [item for item in free(served, project) if item["trajectory"] in held_out]
    assert served.label(project, tests).json()["round"] is None
    assert served.label(project, items[:3]).json()["round"] is None
    started = served.label(project, items[3:5]).json()["round"]
    assert started is not None
    assert served.label(project, items[3:5]).json()["round"] is None
    assert served.label(project, items[5:8]).json()["round"] is None
    assert served.label(project, items[8:]).json()["round"] not in (None, started)
    rounds = served.get("/rounds", project=project)["items"]
    assert [(row["number"], row["labels"], row["watermark"]) for row in rounds] == [(2, 16, 24), (1, 5, 13)]
    kinds = [job["kind"] for job in served.get("/jobs", project=project)["items"]]
    assert kinds.count("train_round") == 2


def test_labelers_at_once_store_each_segment_once_in_one_order(on_both: Served) -> None:
    project = filled(on_both, policy={"round_labels": 10})
    items = free(on_both, project)

    def send(offset: int) -> Json:
        client = TestClient(on_both.app, base_url="http://127.0.0.1", client=("127.0.0.1", 50000))
        turned = items[offset:] + items[:offset]
        answers = [client.post("/labels", json={"project": project, "items": [item]}) for item in turned]
        assert {answer.status_code for answer in answers} == {201}
        bodies = [answer.json() for answer in answers]
        return {"created": sum(b["created"] for b in bodies), "rounds": [b["round"] for b in bodies if b["round"]]}

    with ThreadPoolExecutor(4) as threads:
        outcomes = list(threads.map(send, (0, 3, 5, 8)))
    assert sum(outcome["created"] for outcome in outcomes) == 10
    assert sum(len(outcome["rounds"]) for outcome in outcomes) == 1
    assert [row["watermark"] for row in stored(on_both, project)] == list(range(1, 11))
