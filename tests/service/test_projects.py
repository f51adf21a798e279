"""Projects: what can be set, what is refused with the field and the value, and what a patch leaves alone."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient

from tests.service.kit import ROBOT, ROOM, UNKNOWN, Json, Served, refused


def create(served: Served, **fields: Any) -> Any:
    return served.client.post("/projects", json={"name": "rooms", "environment": ROOM} | fields)


def test_a_project_is_made_with_its_simulators_spaces_and_defaults(served: Served) -> None:
    answer = create(served)
    assert answer.status_code == 201
    project = answer.json()
    assert answer.headers["location"] == f"/projects/{project['id']}"
    assert served.get(answer.headers["location"]) == project
    assert (project["segment_length"], project["stride"], project["held_out_fraction"]) == (1, 1, 0.1)
    assert project["policy"] == {
        "strategy": "confident_cycle",
        "batch_rule": "signatures",
        "round_labels": 100,
        "label_budget": None,
        "lease_seconds": 3600.0,
    }
    assert project["budget"] == {"total": None, "spent": 0, "reserved": 0, "remaining": None}
    assert set(project["counts"].values()) == {0}
    assert (project["label_watermark"], project["current_round"]) == (0, None)
    refused(served.client.get(f"/projects/{UNKNOWN}"), 404, "unknown-resource", UNKNOWN)
    refused(served.client.get("/projects/rooms"), 422, "malformed-request", "project_id", "rooms")


def test_a_name_is_taken_once(served: Served) -> None:
    create(served)
    refused(create(served), 409, "name-taken", "rooms")
    assert len(served.get("/projects")["items"]) == 1


def test_a_name_is_taken_once_by_all_who_ask_at_once(on_both: Served) -> None:
    name = uuid4().hex

    def ask(_: int) -> int:
        client = TestClient(
            on_both.app, base_url="http://127.0.0.1", client=("127.0.0.1", 50000), raise_server_exceptions=False
        )
        return client.post("/projects", json={"name": name, "environment": ROOM}).status_code

    with ThreadPoolExecutor(6) as threads:
        assert sorted(threads.map(ask, range(6))) == [201] + [409] * 5


@pytest.mark.parametrize("name", ["", " ", " rooms", "rooms ", "a/b", "a\nb", "x" * 81, "\u00a0", None, 7])
def test_a_name_that_would_be_hard_to_say_is_refused(served: Served, name: object) -> None:
    refused(create(served, name=name), 422, "malformed-request", "name")


@pytest.mark.parametrize("name", ["a", "Küche 2", "arm-7_(left) \U0001f916", "x" * 80])
def test_other_names_are_kept_as_they_are(served: Served, name: str) -> None:
    assert create(served, name=name).json()["name"] == name
    refused(create(served, name=name), 409, "name-taken", name)


MINIGRID_CASES: list[tuple[Json, list[object]]] = [
    ({"objects": 5, "room_size": 6}, ["5 objects", "room_size 8", "room_size 6"]),
    ({"objects": 5}, ["5 objects", "room_size 6"]),
    ({"objects": 15, "room_size": 8}, ["objects", "14"]),
    ({"room_size": 7}, ["room_size", "6 or 8"]),
    ({"task": "chess"}, ["task", "key_delivery"]),
    ({"noisy_tiles": 5}, ["noisy_tiles", "4"]),
    ({"colour": "red"}, ["colour"]),
]


@pytest.mark.parametrize(("options", "words"), MINIGRID_CASES)
def test_options_of_the_simulator_are_checked_by_name(served: Served, options: Json, words: list[object]) -> None:
    answer = create(served, environment={"simulator": "minigrid", "options": options})
    refused(answer, 422, "malformed-request", "options", *words)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"environment": {}}, ["spaces"]),
        ({"environment": {"simulator": "chess"}}, ["simulator", "chess", "minigrid"]),
        ({"environment": ROBOT | {"simulator": "minigrid"}}, ["spaces", "minigrid"]),
        ({"environment": {"spaces": ROBOT["spaces"] | {"observations": {}}}}, ["observations"]),
        ({"environment": {"spaces": ROBOT["spaces"] | {"actions": {"kind": "discrete", "n": 1}}}}, ["n"]),
        ({"family": "tree"}, ["family", "grid", "robot", "tree"]),
        ({"family": "robot"}, ["family", "'robot' does not take these spaces"]),
        ({"preset": "small"}, ["preset", "'small' is for the robot family"]),
        ({"preset": "huge"}, ["preset", "small", "paper", "huge"]),
        ({"segment_length": 0}, ["segment_length", "0"]),
        ({"segment_length": 4, "stride": 3}, ["stride", "3", "segment_length 4"]),
        ({"held_out_fraction": 1.0}, ["held_out_fraction"]),
        ({"seed": -1}, ["seed"]),
        ({"seed": 1.5}, ["seed"]),
        ({"policy": {"strategy": "psychic"}}, ["strategy", "psychic"]),
        ({"policy": {"label_budget": 0}}, ["label_budget"]),
        ({"policy": {"round_labels": -1}}, ["round_labels"]),
        ({"policy": {"lease_seconds": 0}}, ["lease_seconds"]),
        ({"budget": 10}, ["budget"]),
        ({"policy": {"budget": 10}}, ["policy.budget"]),
    ],
)
def test_a_setting_that_cannot_be_is_refused_by_name(served: Served, fields: Json, words: list[object]) -> None:
    body = refused(create(served, **fields), 422, "malformed-request", *words)
    assert body["invalid_params"]
    assert served.get("/projects")["items"] == []


def test_a_users_own_robot_keeps_its_spaces(served: Served) -> None:
    project = create(served, environment=ROBOT, segment_length=4, stride=6).json()
    assert project["environment"]["spaces"] == {
        "observations": {
            "front": {"dtype": "uint8", "shape": [64, 64, 3], "high": None},
            "wrist": {"dtype": "uint8", "shape": [64, 64, 3], "high": None},
            "proprioception": {"dtype": "float32", "shape": [9], "high": None},
        },
        "actions": {"kind": "box", "shape": [7], "low": -1.0, "high": 1.0, "signs": []},
    }
    assert (project["family"], project["preset"]) == ("robot", "small")
    assert (project["segment_length"], project["stride"]) == (4, 6)
    answer = served.client.post("/collections", json={"project": project["id"], "transitions": 5})
    refused(answer, 409, "no-simulator", project["id"])


def test_a_patch_changes_what_it_names_and_a_null_budget_lifts_it(served: Served) -> None:
    project = create(served, policy={"label_budget": 50}).json()
    path = f"/projects/{project['id']}"
    changed = served.client.patch(path, json={"strategy": "random", "round_labels": 0}).json()
    assert changed["policy"] == project["policy"] | {"strategy": "random", "round_labels": 0}
    assert changed["budget"]["total"] == 50
    assert served.client.patch(path, json={}).json() == changed
    assert served.client.patch(path, json={"strategy": None}).json()["policy"] == changed["policy"]
    lifted = served.client.patch(path, json={"label_budget": None}).json()
    assert lifted["budget"] == {"total": None, "spent": 0, "reserved": 0, "remaining": None}
    assert served.get(path) == lifted
    for patch in ({"name": "other"}, {"segment_length": 2}, {"strategy": "psychic"}, {"label_budget": 0}):
        refused(served.client.patch(path, json=patch), 422, "malformed-request", next(iter(patch)))
    refused(served.client.patch(f"/projects/{UNKNOWN}", json={}), 404, "unknown-resource", UNKNOWN)
    assert served.get(path) == lifted
