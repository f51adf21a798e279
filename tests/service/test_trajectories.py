"""Trajectories go in as npz files, once by content, whole or not at all, and come out bit by bit."""

import io
import pickle
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from numpy.typing import NDArray

from service import pool, projects
from service.store import codec
from service.store.tables import ProjectRow
from tests.service.kit import MAX_BODY_BYTES, ROBOT, UNKNOWN, Arrays, Served, npz, refused, robot, room, same, unpack

GOOD = room(0)


def content(served: Served, project: str, trajectory: str, **query: int) -> Arrays:
    answer = served.client.get(f"/trajectories/{trajectory}/content", params={"project": project, **query})
    assert answer.status_code == 200, answer.text
    return unpack(answer.content)


def test_many_files_go_in_at_once_and_each_has_a_receipt(served: Served) -> None:
    project = served.project()
    receipts = served.upload(project, *[room(seed, transitions=seed + 1) for seed in range(30)])
    assert [receipt["source"] for receipt in receipts] == [f"{number}.npz" for number in range(30)]
    assert [receipt["transitions"] for receipt in receipts] == list(range(1, 31))
    assert {receipt["status"] for receipt in receipts} == {"created"}
    counts = served.show(project)["counts"]
    assert counts["pool_trajectories"] == 30
    assert counts["pool_segments"] == counts["unlabeled"] == sum(range(1, 31))


def test_the_same_content_twice_is_one_trajectory(served: Served) -> None:
    project = served.project()
    turned = {name: np.asfortranarray(array) for name, array in reversed(room(1).items())}
    first, again, other_layout = served.upload(project, room(1), room(1), turned)
    assert (first["status"], again["status"], other_layout["status"]) == ("created", "duplicate", "duplicate")
    assert served.upload(project, room(1))[0] | {"source": "", "status": ""} == first | {"source": "", "status": ""}
    assert served.show(project)["counts"]["pool_trajectories"] == 1


def test_projects_share_the_blob_and_not_the_access(served: Served) -> None:
    here, there, elsewhere = served.project(), served.project(segment_length=5), served.project()
    trajectory = served.upload(here, GOOD)[0]["id"]
    assert served.upload(there, GOOD)[0] == served.upload(here, GOOD)[0] | {"status": "created"}
    blobs = [path for path in (served.settings.data_folder / "blobs").rglob("*") if path.is_file()]
    assert len(blobs) == 1
    shown = served.get(f"/trajectories/{trajectory}", project=here)
    assert (shown["segments"], served.get(f"/trajectories/{trajectory}", project=there)["segments"]) == (5, 1)
    assert same(content(served, there, trajectory), GOOD)
    for path in (f"/trajectories/{trajectory}", f"/trajectories/{trajectory}/content"):
        answer = served.client.get(path, params={"project": elsewhere})
        refused(answer, 404, "unknown-resource", elsewhere, trajectory)
    refused(served.client.get(f"/trajectories/{trajectory}", params={"project": UNKNOWN}), 404, "unknown-resource")


def test_two_projects_may_store_the_same_trajectory_at_once(on_both: Served) -> None:
    first, second = on_both.project(), on_both.project()
    new = room(time.time_ns())  # the tests on PostgreSQL share a database
    held = on_both.services
    with ThreadPoolExecutor(1) as thread:
        with held.database.write() as session:
            row = session.get_one(ProjectRow, UUID(first))
            stored = pool.store(held.blobs, projects.spaces_of(row), new, "0.npz")
            pool.keep(session, [stored], on_both.clock())
            pool.add(session, row, stored, "auto", on_both.clock())
            session.flush()
            waiting = thread.submit(on_both.upload, second, new)
            time.sleep(0.3)  # it has looked for the trajectory, found none, and waits to write it
        assert waiting.result()[0]["status"] == "created"
    assert on_both.show(first)["counts"] == on_both.show(second)["counts"]


def test_a_trajectory_says_what_it_is(served: Served) -> None:
    project = served.project()
    receipt = served.upload(project, GOOD)[0]
    shown = served.get(f"/trajectories/{receipt['id']}", project=project)
    assert shown["streams"] == {
        "grid": {"dtype": "uint8", "shape": [6, 6, 3], "high": [10, 5, 4]},
        "carried": {"dtype": "uint8", "shape": [3], "high": [10, 5, 4]},
    }
    assert (shown["transitions"], shown["segments"], shown["labeled"]) == (5, 5, 0)
    assert (shown["split"], shown["has_provenance"]) == ("pool", False)
    assert shown["bytes"] > 0


def test_windows_of_a_room_come_back_bit_by_bit(served: Served) -> None:
    project = served.project()
    arrays = room(3, transitions=60)
    trajectory = served.upload(project, arrays)[0]["id"]
    assert same(content(served, project, trajectory), arrays)
    for start, length in [(0, 1), (19, 1), (19, 2), (5, 40), (60, 0)]:
        window = {name: array[start : start + length + 1] for name, array in arrays.items()}
        assert same(content(served, project, trajectory, start=start, length=length), window)
    assert same(content(served, project, trajectory, start=58), {n: array[58:] for n, array in arrays.items()})
    for query in ({"start": 61}, {"start": 60, "length": 1}, {"length": 10**30}):
        answer = served.client.get(f"/trajectories/{trajectory}/content", params={"project": project, **query})
        refused(answer, 422, "invalid-field", 60)


def test_windows_of_a_camera_pair_come_back_bit_by_bit(served: Served) -> None:
    project = served.project(environment=ROBOT, segment_length=4)
    arrays = robot(0, transitions=50)
    trajectory = served.upload(project, arrays)[0]["id"]
    for start, length in [(0, 50), (16, 4), (18, 24), (40, 10)]:
        window = {name: array[start : start + length + 1] for name, array in arrays.items()}
        assert same(content(served, project, trajectory, start=start, length=length), window)


def test_the_content_decides_the_split_and_about_the_fraction_is_held_out(served: Served) -> None:
    ids = [codec.content_id({"x": np.array([number])}) for number in range(4000)]
    splits = [pool.content_split(identity, 0.2) for identity in ids]
    assert splits == [pool.content_split(identity, 0.2) for identity in ids]
    assert 0.17 < splits.count("held_out") / len(splits) < 0.23  # 0.2 +- 4.7 standard deviations
    assert {pool.content_split(identity, 0.0) for identity in ids} == {"pool"}
    first, second = served.project(held_out_fraction=0.5), served.project(held_out_fraction=0.5)
    rooms = [room(seed, 1) for seed in range(40)]
    given = [receipt["split"] for receipt in served.upload(first, *rooms)]
    assert set(given) == {"pool", "held_out"}
    assert [receipt["split"] for receipt in served.upload(second, *rooms)] == given


def test_a_split_can_be_chosen_once(served: Served) -> None:
    project = served.project()
    trajectory = served.upload(project, GOOD, split="held_out")[0]
    assert trajectory["split"] == "held_out"
    assert served.upload(project, GOOD)[0]["split"] == "held_out"
    answer = served.send(project, [("1.npz", npz(room(1))), ("0.npz", npz(GOOD))], split="pool")
    refused(answer, 409, "split-conflict", trajectory["id"], "held_out", "pool")
    counts = served.show(project)["counts"]
    assert (counts["pool_trajectories"], counts["held_out_trajectories"]) == (0, 1)
    refused(served.send(project, [("0.npz", npz(GOOD))], split="train"), 422, "malformed-request", "train")


def _zip(name: str, data: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
    return buffer.getvalue()


def _npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


ROUGH = GOOD | {"carried": GOOD["carried"].astype(object)}
BAD: dict[str, tuple[bytes, int, str, list[object]]] = {
    "lengths disagree": (npz(GOOD | {"carried": GOOD["carried"][:-1]}), 422, "invalid-trajectory", ["length", 6, 5]),
    "another dtype": (npz(GOOD | {"grid": GOOD["grid"].astype(np.int64)}), 422, "invalid-trajectory", ["int64"]),
    "another byte order": (npz(GOOD | {"grid": GOOD["grid"].astype(">i4")}), 422, "invalid-trajectory", [">i4"]),
    "a stream is missing": (npz({"grid": GOOD["grid"]}), 422, "invalid-trajectory", ["['grid']", "carried"]),
    "a stream too many": (npz(GOOD | {"actions": GOOD["carried"]}), 422, "invalid-trajectory", ["actions"]),
    "another shape": (npz(room(0, size=8)), 422, "invalid-trajectory", ["(6, 8, 8, 3)", "(T + 1, 6, 6, 3)"]),
    "no time axis": (npz(GOOD | {"grid": np.array(3, np.uint8)}), 422, "invalid-trajectory", ["()"]),
    "one observation": (npz({n: a[:1] for n, a in GOOD.items()}), 422, "invalid-trajectory", ["at least 2"]),
    "no observation": (npz({n: a[:0] for n, a in GOOD.items()}), 422, "invalid-trajectory", ["at least 2"]),
    "truncated": (npz(GOOD)[:-200], 400, "foreign-file", ["bad.npz"]),
    "empty": (b"", 400, "foreign-file", ["bad.npz"]),
    "a text": (b"trajectory,1,2,3\n" * 100, 400, "foreign-file", ["bad.npz"]),
    "a bare array": (_npy(GOOD["grid"]), 400, "foreign-file", ["bad.npz"]),
    "another archive": (_zip("grid", b"a text and no array"), 400, "foreign-file", ["bad.npz"]),
    "a pickle": (pickle.dumps(GOOD), 400, "foreign-file", ["bad.npz"]),
    "pickled objects": (npz(ROUGH), 400, "foreign-file", ["bad.npz", "object"]),
    "a bomb": (_zip("grid.npy", bytes(MAX_BODY_BYTES + 1)), 400, "foreign-file", [MAX_BODY_BYTES + 1, MAX_BODY_BYTES]),
}


@pytest.mark.parametrize("case", BAD)
def test_one_bad_file_among_good_ones_leaves_nothing(served: Served, case: str) -> None:
    project = served.project()
    served.upload(project, room(9))
    before, events = served.show(project), served.get("/events", project=project)
    data, status, kind, words = BAD[case]
    files = [("good.npz", npz(room(1))), ("bad.npz", data), ("fine.npz", npz(room(2)))]
    refused(served.send(project, files), status, kind, *words)
    assert served.show(project) == before
    assert served.get("/events", project=project) == events
    assert len(served.get("/trajectories", project=project)["items"]) == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_refused_with_its_place(served: Served, value: float) -> None:
    project = served.project(environment=ROBOT, segment_length=4)
    arrays = robot(0)
    arrays["proprioception"][7, 3] = value
    answer = served.send(project, [("bad.npz", npz(arrays))])
    refused(answer, 422, "invalid-trajectory", "bad.npz: proprioception[7, 3]", value)
    assert served.show(project)["counts"]["pool_trajectories"] == 0


def test_an_upload_needs_a_project_and_files(served: Served) -> None:
    refused(served.send(UNKNOWN, [("0.npz", npz(GOOD))]), 404, "unknown-resource", UNKNOWN)
    refused(served.send(served.project(), []), 422, "malformed-request", "files")
    answer = served.client.post("/trajectories", params={"project": served.project()}, json={"files": []})
    refused(answer, 422, "malformed-request", "files")


def test_a_trajectory_shorter_than_a_segment_has_none(served: Served) -> None:
    project = served.project(segment_length=6, stride=8)
    trajectories = [room(seed, transitions) for seed, transitions in enumerate((5, 6, 13, 14, 22))]
    ids = [receipt["id"] for receipt in served.upload(project, *trajectories)]
    cut = [served.get(f"/trajectories/{identity}", project=project)["segments"] for identity in ids]
    assert cut == [0, 1, 1, 2, 3]
    assert served.show(project)["counts"]["pool_segments"] == 7
