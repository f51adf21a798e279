"""How much one request may carry, and how much of it an answer shows."""

import base64
import io
import warnings
import zipfile
from typing import Any

import numpy as np
import pytest

from api_schemas.labels import MOST_SEGMENTS
from tests.service.conftest import Serve
from tests.service.kit import MAX_BODY_BYTES, ROBOT, UNKNOWN, Json, Served, npz, refused, robot

POINT: Json = {
    "spaces": {
        "observations": {"point": {"dtype": "uint8", "shape": (1,)}},
        "actions": {"kind": "box", "shape": (7,), "low": -1.0, "high": 1.0},
    }
}
STILL = [0.0] * 7


def labeled(transitions: int, seed: int = 0, **more: Any) -> Json:
    """A trajectory of points with its actions."""
    points = np.random.default_rng(seed).integers(0, 256, (transitions + 1, 1), np.uint8)
    content = base64.b64encode(npz({"point": points})).decode()
    return {"content": content, "actions": [[0] * 7] * transitions} | more


def test_one_request_brings_so_many_segments_and_no_more(served: Served) -> None:
    project, half = served.project(environment=POINT), MOST_SEGMENTS // 2
    sent = [labeled(half, 1), labeled(half, 2), labeled(1, 3)]
    refused(
        served.label(project, [], trajectories=sent), 422, "invalid-field", "segments", MOST_SEGMENTS, MOST_SEGMENTS + 1
    )
    assert served.show(project)["counts"]["pool_trajectories"] == 0
    few = labeled(MOST_SEGMENTS + 1, starts=[0, MOST_SEGMENTS])
    assert served.label(project, [], trajectories=[few]).json()["created"] == 2


def test_segments_are_counted_as_the_project_cuts_them(served: Served) -> None:
    project = served.project(environment=POINT, segment_length=10, stride=20_000)
    assert served.label(project, [], trajectories=[labeled(MOST_SEGMENTS + 10)]).json()["created"] == 2


def test_a_segment_is_named_once(served: Served) -> None:
    project = served.project(environment=POINT)
    answer = served.label(project, [], trajectories=[labeled(3, starts=[1, 2, 1])])
    refused(answer, 422, "malformed-request", "trajectories.0", "starts", "more than once")


@pytest.mark.parametrize("length", [1000, 3])
def test_a_conflict_shows_where_labels_differ_however_long_they_are(on_both: Served, length: int) -> None:
    project = on_both.project(environment=POINT, segment_length=length)
    stored = [[step / length] * 7 for step in range(length)]
    (receipt,) = on_both.label(project, [], trajectories=[labeled(length) | {"actions": stored}]).json()["receipts"]
    other = [STILL if step >= length // 2 else action for step, action in enumerate(stored)]
    item = {"trajectory": receipt["trajectory"], "start": 0, "actions": other}
    problem = refused(on_both.label(project, [item]), 409, "label-conflict", receipt["trajectory"])
    assert f"different in {length - length // 2} of {length} steps" in problem["detail"]
    assert len(problem["detail"]) < 1000
    shown = problem["invalid_params"]
    assert len(shown) == min(5, length - length // 2)
    assert shown[0]["name"] == f"step {length // 2}"
    assert str(stored[length // 2]) in shown[0]["reason"]
    assert shown[0]["value"] == str(STILL)


def test_as_many_connections_are_held_as_the_settings_allow(start: Serve) -> None:
    assert start(pool_size=3).services.database.engine.pool.size() == 3  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ([1] * 9, ["shape", "at most 8 items"]),
        ([2**12, 2**12, 2], ["shape", 2**25, 2**24]),
        ([2**25], ["shape.0", 2**24]),
        ([0], ["shape.0"]),
        ([True], ["shape.0", "must be a number"]),
    ],
)
def test_an_array_has_so_many_axes_and_numbers_and_no_more(served: Served, shape: Any, words: list[object]) -> None:
    spaces = {"observations": {"point": {"dtype": "uint8", "shape": shape}}, "actions": POINT["spaces"]["actions"]}
    answer = served.client.post("/projects", json={"name": "large", "environment": {"spaces": spaces}})
    refused(answer, 422, "malformed-request", *words)


def test_an_observation_has_so_many_streams_and_no_more(served: Served) -> None:
    stream = {"dtype": "uint8", "shape": (1,)}
    for count in (64, 65):
        streams = {f"point{number}": stream for number in range(count)}
        spaces = {"observations": streams, "actions": POINT["spaces"]["actions"]}
        answer = served.client.post("/projects", json={"name": f"{count}", "environment": {"spaces": spaces}})
        assert answer.status_code == (201 if count == 64 else 422), answer.text


def test_files_of_one_request_share_what_they_may_unpack_to(served: Served) -> None:
    project = served.project(environment=POINT)
    still = [npz({"point": np.full((MAX_BODY_BYTES // 3, 1), number, np.uint8)}) for number in range(3)]
    small = [compressed(file) for file in still]
    assert sum(map(len, small)) < MAX_BODY_BYTES // 100
    answer = served.send(project, [(f"{number}.npz", file) for number, file in enumerate(small)])
    refused(answer, 400, "foreign-file", "2.npz", "the files before it", MAX_BODY_BYTES)
    assert served.show(project)["counts"]["pool_trajectories"] == 0
    assert served.send(project, [(f"{number}.npz", file) for number, file in enumerate(small[:2])]).status_code == 201


def test_a_file_has_so_many_members_and_no_more(served: Served) -> None:
    project = served.project(environment=POINT)
    many = npz({f"point{number}": np.zeros((2, 1), np.uint8) for number in range(67)})
    refused(served.send(project, [("many.npz", many)]), 400, "foreign-file", "many.npz", 67, 66)


def test_a_directory_is_refused_before_objects_are_made_of_it(served: Served) -> None:
    project, buffer = served.project(environment=POINT), io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for number in range(2_000):
            archive.writestr(f"point{number}.npy", b"")
    answer = served.send(project, [("wide.npz", buffer.getvalue())])
    refused(answer, 400, "foreign-file", "wide.npz", "a directory of", "65558 are allowed")


def test_a_file_names_a_stream_once(served: Served) -> None:
    project, buffer = served.project(environment=POINT), io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zipfile's, of the name that comes twice
        for number in range(2):
            content = io.BytesIO()
            np.save(content, np.full((2, 1), number, np.uint8))
            archive.writestr("point.npy", content.getvalue())
    refused(
        served.send(project, [("twice.npz", buffer.getvalue())]), 400, "foreign-file", "twice.npz", "twice: ['point"
    )


def test_one_bad_file_of_a_request_leaves_no_blob_of_the_others(served: Served) -> None:
    project, blobs = served.project(environment=ROBOT), served.settings.data_folder / "blobs"
    good, bad = robot(0), robot(1)
    bad["proprioception"][3, 2] = np.nan
    refused(
        served.send(project, [("0.npz", npz(good)), ("1.npz", npz(bad))]), 422, "invalid-trajectory", "1.npz", "nan"
    )
    assert not [path for path in blobs.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    "told", ["[" * 20_000, '["0001-01-01T00:00:00+14:00", "x"]', f"[{2**70}, 1]", "{}", "[[], []]"]
)
def test_a_cursor_of_ones_own_is_refused(on_both: Served, told: str) -> None:
    cursor = base64.urlsafe_b64encode(told.encode()).decode()
    for path in ("/keys", "/projects", "/events"):
        refused(on_both.client.get(path, params={"cursor": cursor}), 422, "invalid-field", "cursor")


@pytest.mark.parametrize("when", ["9999-12-31T23:59:59-10:00", "0001-01-01T00:00:00+14:00"])
def test_a_time_has_one_in_utc(served: Served, when: str) -> None:
    body = {"name": "ada", "scopes": ["read"], "expires_at": when}
    refused(served.client.post("/keys", json=body), 422, "malformed-request", "expires_at", "UTC")


def test_a_body_of_many_lists_is_refused_before_they_are_made(served: Served) -> None:
    body = b'{"items": [' + b"[]," * 1_000_001 + b"[]]}"
    answer = served.client.post("/labels", content=body, headers={"Content-Type": "application/json"})
    refused(answer, 413, "body-too-large", "lists and objects", 1_000_000)


def test_a_stream_is_not_named_as_files_name_something_else(served: Served) -> None:
    spaces = {"observations": {"__metadata__": {"dtype": "uint8", "shape": [1]}}, "actions": POINT["spaces"]["actions"]}
    answer = served.client.post("/projects", json={"name": "x", "environment": {"spaces": spaces}})
    refused(answer, 422, "malformed-request", "__metadata__")


def test_a_list_of_wrong_values_is_refused_by_its_first(served: Served) -> None:
    project = served.project(environment=POINT)
    sent = labeled(2) | {"actions": ["wrong"] * 100_000}
    problem = refused(served.label(project, [], trajectories=[sent]), 422, "malformed-request", "actions.0")
    assert len(problem["invalid_params"]) <= 3
    assert len(problem["detail"]) < 2000


def test_a_refusal_shows_so_many_fields_and_so_much_of_each(served: Served) -> None:
    few = {f"field{number}": "x" * 5000 for number in range(25)}
    problem = refused(served.client.post("/projects", json=few), 422, "malformed-request", "name", "field0")
    assert len(problem["invalid_params"]) == 20
    assert max(len(param["value"]) for param in problem["invalid_params"]) == 200
    many = {f"field{number}": 0 for number in range(10_000)}
    problem = refused(
        served.client.post("/projects", json=many), 422, "malformed-request", "has 10000 fields, 9 are known"
    )
    assert len(problem["detail"]) < 1000


def test_a_body_that_brings_no_data_is_short(served: Served) -> None:
    body = b'{"name": "' + b"x" * served.settings.max_json_bytes + b'"}'
    answer = served.client.post("/projects", content=body, headers={"Content-Type": "application/json"})
    refused(answer, 413, "body-too-large", len(body), served.settings.max_json_bytes)


@pytest.mark.parametrize("value", [True, "5", "x", None, [5]])
def test_a_number_in_a_body_is_a_number(served: Served, value: Any) -> None:
    answer = served.client.post("/acquire", json={"project": UNKNOWN, "count": value})
    refused(answer, 422, "malformed-request", "count")
    assert served.client.post("/acquire", json={"project": UNKNOWN, "count": 5.0}).status_code == 404


def compressed(file: bytes) -> bytes:
    """The same members, deflated."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(file)) as whole, zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as small:
        for name in whole.namelist():
            small.writestr(name, whole.read(name))
    return buffer.getvalue()
