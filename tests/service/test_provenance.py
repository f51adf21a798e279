"""Simulator states: collected beside the trajectories, kept apart from them, served to labelers only."""

import json
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from service.store.tables import JobRow
from tests.service.conftest import Serve
from tests.service.kit import UNKNOWN, Json, Served, refused, room, unpack


def collected(served: Served, **fields: object) -> tuple[str, Json]:
    """A project with a collection of forty transitions, and its first trajectory."""
    project = served.project()
    asked = {"project": project, "behavior": "random", "transitions": 40, "seed": 3} | fields
    answer = served.client.post("/collections", json=asked)
    assert answer.status_code == 202
    assert answer.headers["location"] == f"/jobs/{answer.json()['id']}"
    assert served.drain("label") == 1
    assert served.get(answer.headers["location"])["state"] == "done"
    return project, served.get("/trajectories", project=project)["items"][0]


def test_a_collection_brings_trajectories_and_their_states(served: Served) -> None:
    project, trajectory = collected(served)
    assert trajectory["has_provenance"]
    assert served.show(project)["counts"]["pool_segments"] == 40
    answer = served.client.get(f"/trajectories/{trajectory['id']}/provenance", params={"project": project})
    arrays = unpack(answer.content)
    metadata = json.loads(str(arrays.pop("__metadata__")))
    assert (metadata["simulator"], metadata["behavior"]) == ("minigrid", "random")
    assert {len(array) for array in arrays.values()} == {trajectory["transitions"] + 1}
    query: dict[str, str | int] = {"project": project, "start": 2, "length": 3}
    window = unpack(served.client.get(f"/trajectories/{trajectory['id']}/provenance", params=query).content)
    for name, array in arrays.items():
        assert np.array_equal(window[name], array[2:6])
    query |= {"length": trajectory["transitions"]}
    refused(served.client.get(f"/trajectories/{trajectory['id']}/provenance", params=query), 422, "invalid-field")


def test_states_are_in_no_blob_that_training_can_open(served: Served) -> None:
    collected(served)
    folder = served.settings.data_folder
    assert any(path.is_file() for path in (folder / "provenance").rglob("*"))
    stored = [path.relative_to(folder / "blobs") for path in (folder / "blobs").rglob("*/*/*") if path.is_file()]
    assert {path.parts[0] for path in stored} == {"trajectories"}


def test_a_process_without_the_store_has_no_states_to_serve(start: Serve) -> None:
    project, trajectory = collected(start())
    blind = start(provenance_url="")
    path = f"/trajectories/{trajectory['id']}/provenance"
    refused(blind.client.get(path, params={"project": project}), 404, "no-provenance", trajectory["id"])
    assert blind.client.get(path.replace("provenance", "content"), params={"project": project}).status_code == 200


def test_a_trajectory_without_states_says_so(served: Served) -> None:
    project = served.project()
    (trajectory,) = served.upload(project, room(0))
    path = f"/trajectories/{trajectory['id']}/provenance"
    refused(served.client.get(path, params={"project": project}), 404, "no-provenance", trajectory["id"])
    refused(served.client.get(path, params={"project": served.project()}), 404, "unknown-resource")


def test_states_need_the_scope_of_a_labeler(served: Served) -> None:
    project, trajectory = collected(served)
    path = f"/trajectories/{trajectory['id']}/provenance?project={project}"
    for scope, status in (("read", 403), ("acquire", 403), ("label", 200)):
        secret = served.client.post("/keys", json={"name": "a", "scopes": [scope]}).json()["secret"]
        answer = served.client.get(path, headers={"Authorization": f"Bearer {secret}"})
        assert answer.status_code == status
        if status == 403:
            refused(answer, 403, "not-allowed", "'label'", scope)


def test_a_collection_that_cannot_run_is_refused(served: Served) -> None:
    project = served.project(segment_length=2)
    asked = {"project": project, "transitions": 10}
    refused(served.client.post("/collections", json=asked | {"project": UNKNOWN}), 404, "unknown-resource")
    answer = served.client.post("/collections", json=asked | {"behavior": "psychic"})
    refused(answer, 422, "unknown-behavior", "psychic", "expert")
    answer = served.client.post("/collections", json=asked | {"labels": {"per_action": 2}})
    refused(answer, 422, "invalid-field", "labels.per_action", 2)
    for labels, name in (({"all": True}, "labels.all"), ({"segments": 3}, "labels.segments")):
        refused(served.client.post("/collections", json=asked | {"labels": labels}), 422, "invalid-field", name)
    assert served.get("/jobs", project=project)["items"] == []


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({}, "transitions: give transitions or trajectories, and one of them only; got neither"),
        ({"transitions": 5, "trajectories": 6}, "got 5 and 6"),
        ({"trajectories": 0}, "greater than or equal to 1"),
        ({"trajectories": 3, "shards": 4}, "shards: 4 of them cannot share 3 trajectories"),
        ({"transitions": 9, "shards": 4, "labels": {"per_action": 2}}, "shards: 4 of them cannot share 2 labels"),
        ({"transitions": 9, "shards": 65}, "less than or equal to 64"),
        ({"transitions": 9, "labels": {"all": 1}}, "labels.all: Input should be a valid boolean"),
        ({"transitions": 9, "labels": {}}, "labels: give per_action, segments or all, and one of them only"),
        ({"transitions": 9, "labels": {"all": True, "segments": 2}}, "and one of them only"),
    ],
)
def test_a_collection_of_two_minds_is_refused_in_a_sentence(
    served: Served, fields: dict[str, object], sentence: str
) -> None:
    answer = served.client.post("/collections", json={"project": served.project(), **fields})
    assert answer.status_code == 422
    assert sentence in answer.text


def test_shards_are_jobs_with_shares_that_make_up_the_whole(served: Served) -> None:
    project = served.project()
    asked = {"project": project, "trajectories": 8, "shards": 3, "labels": {"per_action": 4}}
    answer = served.client.post("/collections", json=asked).json()
    assert len(set(answer["jobs"])) == 3
    assert answer["id"] == answer["jobs"][0]
    with served.services.database.read() as session:
        payloads = [session.get_one(JobRow, UUID(job)).payload for job in answer["jobs"]]
    collections: list[Any] = [payload["collection"] for payload in payloads]
    assert [each["trajectories"] for each in collections] == [3, 3, 2]
    assert [each["labels"]["per_action"] for each in collections] == [2, 1, 1]
    assert [payload["shard"] for payload in payloads] == [0, 1, 2]
