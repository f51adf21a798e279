"""Blobs on a folder and on an S3-compatible server keep the same promises, and so does the service on top of them."""

import hashlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import pytest

from service.store.blobs import Blobs
from service.store.errors import BlobsUnavailable, CorruptBlob, MissingBlob
from service.store.provenance import ProvenanceBlobs
from tests.object_store import BUCKET, ObjectStore, object_store
from tests.service.conftest import Serve
from tests.service.kit import answers, npz, refused, room, segments

CONTENT = b"immutable bytes"
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture(scope="module")
def s3_server() -> Iterator[ObjectStore]:
    with object_store() as server:
        yield server


@pytest.fixture
def s3(s3_server: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> ObjectStore:
    """The server, with the variables set that reach it."""
    for name, value in s3_server.environment.items():
        monkeypatch.setenv(name, value)
    return s3_server


@dataclass
class Place:
    """Blobs somewhere, and how to look into that place and damage it without them."""

    url: str
    keys: Callable[[], list[str]]
    overwrite: Callable[[str, bytes], object]

    def blobs(self) -> Blobs:
        return Blobs(self.url)


@pytest.fixture(params=["folder", "s3"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    if request.param == "folder":
        root = tmp_path / "blobs"
        return Place(
            str(root),
            lambda: [str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()],
            lambda key, data: (root / key).write_bytes(data),
        )
    server: ObjectStore = request.getfixturevalue("s3")
    prefix = f"team/{uuid4().hex}"
    return Place(
        f"s3://{BUCKET}/{prefix}",
        lambda: [key.removeprefix(f"{prefix}/") for key in server.listed() if key.startswith(f"{prefix}/")],
        lambda key, data: server.overwrite(f"{prefix}/{key}", data),
    )


def test_what_was_put_is_got_under_its_hash(place: Place) -> None:
    assert place.blobs().put("weights", CONTENT) == SHA256
    assert place.blobs().get("weights", SHA256) == CONTENT
    assert place.keys() == [f"weights/{SHA256[:2]}/{SHA256}"]


def test_putting_again_changes_nothing(place: Place) -> None:
    blobs = place.blobs()
    assert [blobs.put("scores", CONTENT) for _ in range(3)] == [SHA256] * 3
    assert len(place.keys()) == 1
    assert blobs.get("scores", SHA256) == CONTENT


def test_a_torn_object_is_refused_and_mended_by_the_next_put(place: Place) -> None:
    blobs = place.blobs()
    blobs.put("checkpoints", CONTENT)
    place.overwrite(place.keys()[0], CONTENT[:-1])
    with pytest.raises(CorruptBlob, match=SHA256):
        blobs.get("checkpoints", SHA256)
    blobs.put("checkpoints", CONTENT)
    assert blobs.get("checkpoints", SHA256) == CONTENT


def test_a_missing_blob_is_named(place: Place) -> None:
    with pytest.raises(MissingBlob, match=f"weights/{SHA256[:2]}/{SHA256}"):
        place.blobs().get("weights", SHA256)


def test_a_deleted_blob_is_gone_and_may_be_deleted_and_put_again(place: Place) -> None:
    blobs = place.blobs()
    kept = blobs.put("checkpoints", b"another")
    blobs.put("checkpoints", CONTENT)
    blobs.delete("checkpoints", SHA256)
    blobs.delete("checkpoints", SHA256)
    with pytest.raises(MissingBlob):
        blobs.get("checkpoints", SHA256)
    assert blobs.get("checkpoints", kept) == b"another"
    blobs.put("checkpoints", CONTENT)
    assert blobs.get("checkpoints", SHA256) == CONTENT


def test_many_writers_of_one_content_leave_one_whole_object(place: Place) -> None:
    content = bytes(range(256)) * 4096
    stores = [place.blobs() for _ in range(4)]
    with ThreadPoolExecutor(16) as pool:
        put = set(pool.map(lambda number: stores[number % 4].put("trajectories", content), range(32)))
    assert put == {hashlib.sha256(content).hexdigest()}
    assert len(place.keys()) == 1
    assert stores[0].get("trajectories", put.pop()) == content


def test_projects_of_two_prefixes_do_not_meet(s3: ObjectStore) -> None:
    one, other = (Blobs(f"s3://{BUCKET}/{uuid4().hex}") for _ in range(2))
    one.put("weights", CONTENT)
    with pytest.raises(MissingBlob):
        other.get("weights", SHA256)


def test_a_store_without_conditional_put_takes_the_same_content_twice(
    s3: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_CONDITIONAL_PUT", "disabled")
    blobs = Blobs(f"s3://{BUCKET}/{uuid4().hex}")
    assert {blobs.put("weights", CONTENT), blobs.put("weights", CONTENT)} == {SHA256}
    assert blobs.get("weights", SHA256) == CONTENT


def test_a_bucket_that_is_not_there_is_said_so(s3: ObjectStore) -> None:
    blobs = Blobs("s3://no-such-bucket/prefix")
    assert not blobs.reachable()
    with pytest.raises(BlobsUnavailable, match="404 Not Found"):
        blobs.put("weights", CONTENT)


def test_plain_http_has_to_be_allowed(s3: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AWS_ALLOW_HTTP")
    blobs = Blobs(f"s3://{BUCKET}")
    assert not blobs.reachable()
    with pytest.raises(BlobsUnavailable):
        blobs.put("weights", CONTENT)


def test_a_server_that_is_gone_is_unreachable_and_every_call_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    with object_store() as server:
        for name, value in server.environment.items():
            monkeypatch.setenv(name, value)
        blobs = Blobs(f"s3://{BUCKET}/prefix")
        blobs.put("weights", CONTENT)
        assert blobs.reachable()
        server.stop()
        assert not blobs.reachable()
        for call in (
            lambda: blobs.put("weights", CONTENT),
            lambda: blobs.get("weights", SHA256),
            lambda: blobs.delete("weights", SHA256),
        ):
            with pytest.raises(BlobsUnavailable, match=f"weights/{SHA256[:2]}/{SHA256}"):
                call()
        server.start()
        assert blobs.put("weights", CONTENT) == SHA256


def test_provenance_has_a_root_of_its_own(s3: ObjectStore) -> None:
    root = f"s3://{BUCKET}/{uuid4().hex}"
    sha256 = ProvenanceBlobs(f"{root}/provenance").put("provenance", CONTENT)
    with pytest.raises(MissingBlob):
        Blobs(f"{root}/blobs").get("trajectories", sha256)


def test_the_service_collects_scores_acquires_and_labels_on_s3(start: Serve, s3: ObjectStore) -> None:
    prefix = uuid4().hex
    urls = {name: f"s3://{BUCKET}/{prefix}/{name}" for name in ("blobs", "provenance")}
    served = start(blobs_url=urls["blobs"], provenance_url=urls["provenance"])
    project = served.project(policy={"strategy": "random"})
    receipts = served.upload(project, room(1), room(2))
    collected = served.client.post("/collections", json={"project": project, "transitions": 50, "split": "pool"})
    assert collected.status_code == 202, collected.text
    assert served.drain("label") == 1
    batch = served.acquire(project, 20)
    assert len(set(segments(batch))) == 20
    accepted = served.label(project, answers(batch), batch)
    assert accepted.status_code == 201, accepted.text
    assert served.show(project)["counts"]["labeled"] == 20
    content = served.client.get(f"/trajectories/{receipts[0]['id']}/content", params={"project": project})
    assert content.status_code == 200, content.text
    kinds = {"/".join(key.split("/")[1:3]) for key in s3.listed() if key.startswith(prefix)}
    assert {"blobs/trajectories", "blobs/scores", "provenance/provenance"} <= kinds
    assert not (served.settings.data_folder / "blobs").exists()
    assert not (served.settings.data_folder / "provenance").exists()


def test_while_the_store_is_away_the_service_says_503_and_nothing_is_half_done(
    start: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    with object_store() as server:
        for name, value in server.environment.items():
            monkeypatch.setenv(name, value)
        served = start(blobs_url=f"s3://{BUCKET}/blobs")
        project = served.project()
        trajectory = served.upload(project, room(1))[0]["id"]
        server.stop()
        answer = served.client.get(f"/trajectories/{trajectory}/content", params={"project": project})
        refused(answer, 503, "blobs-unavailable", "trajectories/")
        assert answer.headers["retry-after"] == "1"
        upload = [("files", ("two.npz", npz(room(2))))]
        refused(
            served.client.post("/trajectories", params={"project": project}, files=upload), 503, "blobs-unavailable"
        )
        assert served.show(project)["counts"]["pool_segments"] == 5
        assert served.client.get("/health/ready").json()["blobs"] is False
        server.start()
        assert served.upload(project, room(2))[0]["status"] == "created"
