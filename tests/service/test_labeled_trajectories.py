"""Trajectories that come with their actions: they join the pool labeled, without a lease."""

import pytest

from tests.service.kit import ROBOT, Arrays, Json, Served, refused, robot, room
from tests.service.test_labels import filled, free, labeled, stored


def test_a_labeled_trajectory_joins_the_pool_without_a_lease(on_both: Served) -> None:
    project = on_both.project()
    upload = labeled(room(0), [0, 1, 2, 3, 4])
    accepted = on_both.label(project, [], trajectories=[upload, labeled(room(1), [6] * 5, starts=[4, 1])])
    assert accepted.json()["created"] == 7
    rows = stored(on_both, project)
    assert [row["actions"] for row in rows] == [[0], [1], [2], [3], [4], [6], [6]]
    assert [row["start"] for row in rows[5:]] == [4, 1]
    assert on_both.show(project)["counts"] | {"leased": 0} == {
        "pool_trajectories": 2,
        "pool_segments": 10,
        "unlabeled": 3,
        "leased": 0,
        "labeled": 7,
        "held_out_trajectories": 0,
        "held_out_segments": 0,
        "held_out_labeled": 0,
    }
    assert on_both.label(project, [], trajectories=[upload]).json()["duplicates"] == 5
    conflict = on_both.label(project, [], trajectories=[labeled(room(0), [0, 1, 2, 3, 5])])
    refused(conflict, 409, "label-conflict", "[4]", "[5]")


def test_a_trajectory_shorter_than_a_segment_takes_no_label(served: Served) -> None:
    project = served.project(segment_length=6)
    (short,) = served.upload(project, room(0, transitions=5))
    item = {"trajectory": short["id"], "start": 0, "actions": [0] * 6}
    refused(served.label(project, [item]), 422, "invalid-label", "less than 6 transitions")
    accepted = served.label(project, [], trajectories=[labeled(room(1, transitions=5), [0] * 5)])
    assert (accepted.status_code, accepted.json()["created"]) == (201, 0)


def test_a_labeled_trajectory_may_be_held_out(served: Served) -> None:
    project = served.project(policy={"round_labels": 1})
    sets = [[0], [0, 1], [0], [0], [0]]
    upload = labeled(room(0), [0] * 5, split="held_out", action_sets=sets)
    accepted = served.label(project, [], trajectories=[upload]).json()
    assert {receipt["split"] for receipt in accepted["receipts"]} == {"held_out"}
    assert accepted["round"] is None
    assert served.show(project)["counts"]["held_out_labeled"] == 5
    assert [row["action_sets"] for row in stored(served, project)] == [[choices] for choices in sets]
    conflict = served.label(project, [], trajectories=[upload | {"split": "pool"}])
    refused(conflict, 409, "split-conflict")


@pytest.mark.parametrize(
    ("arrays", "fields", "status", "kind", "words"),
    [
        (room(1), {"actions": [0] * 4}, 422, "invalid-label", ["length", "must be 5", 4]),
        (room(1), {"actions": [0, 0, 9, 0, 0]}, 422, "invalid-label", ["trajectories[1].actions[2]", 9]),
        (room(1), {"starts": [5]}, 422, "invalid-label", ["start", 5]),
        (room(1), {"starts": [-1]}, 422, "invalid-label", ["start", -1]),
        (room(1), {"starts": [10**15]}, 422, "invalid-label", ["start", 10**15]),
        (room(1), {"action_sets": [[0]]}, 422, "invalid-label", ["action_sets", 1]),
        (room(1), {"content": "AAAA"}, 400, "foreign-file", ["trajectories[1].content"]),
        (room(1), {"content": "A"}, 422, "malformed-request", ["trajectories.1.content"]),
        (room(1, size=8), {}, 422, "invalid-trajectory", ["trajectories[1]", "(6, 8, 8, 3)"]),
    ],
)
def test_one_bad_trajectory_leaves_nothing_of_the_request(
    served: Served, arrays: Arrays, fields: Json, status: int, kind: str, words: list[object]
) -> None:
    project = filled(served)
    before, events = served.show(project), served.get("/events", project=project)
    uploads = [labeled(room(7), [0] * 5), labeled(arrays, [0] * 5) | fields]
    answer = served.label(project, free(served, project)[:2], trajectories=uploads)
    refused(answer, status, kind, *words)
    assert served.show(project) == before
    assert served.get("/events", project=project) == events


def test_starts_of_a_robots_trajectory_are_on_its_stride(served: Served) -> None:
    project = served.project(environment=ROBOT, segment_length=4)
    upload = labeled(robot(0, 11), [[0.25] * 7] * 11)
    for start in (2, 8):
        answer = served.label(project, [], trajectories=[upload | {"starts": [start]}])
        refused(answer, 422, "invalid-label", "multiple of 4 up to 4", start)
    assert served.label(project, [], trajectories=[upload]).json()["created"] == 2
    assert [row["start"] for row in stored(served, project)] == [0, 4]
    assert {len(row["actions"]) for row in stored(served, project)} == {4}
