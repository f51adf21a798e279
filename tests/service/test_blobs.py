"""Blobs are named by their content, written once, and checked whenever they are read."""

import hashlib
from pathlib import Path

import pytest

from service.store.blobs import Blobs
from service.store.errors import CorruptBlob, MissingBlob
from tests.service.kit import Served, refused, room


def path_of(folder: Path, sha256: str) -> Path:
    (path,) = folder.rglob(sha256)
    return path


def test_a_blob_is_stored_under_its_hash_and_comes_back(tmp_path: Path) -> None:
    blobs = Blobs(str(tmp_path / "new" / "folder"))
    sha256 = blobs.put("weights", b"some weights")
    assert sha256 == hashlib.sha256(b"some weights").hexdigest()
    assert Blobs(str(tmp_path / "new" / "folder")).get("weights", sha256) == b"some weights"


def test_the_same_bytes_are_written_once(tmp_path: Path) -> None:
    blobs = Blobs(str(tmp_path))
    path = path_of(tmp_path, blobs.put("scores", b"scores"))
    before = path.stat()
    assert blobs.put("scores", b"scores") == path.name
    after = path.stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert [found for found in tmp_path.rglob("*") if found.is_file()] == [path]


def test_a_changed_blob_is_refused_with_both_hashes_and_mended_by_the_next_put(tmp_path: Path) -> None:
    blobs = Blobs(str(tmp_path))
    sha256 = blobs.put("checkpoints", b"whole")
    path_of(tmp_path, sha256).write_bytes(b"torn")
    with pytest.raises(CorruptBlob, match=f"{sha256}.*{hashlib.sha256(b'torn').hexdigest()}"):
        blobs.get("checkpoints", sha256)
    assert blobs.put("checkpoints", b"whole") == sha256
    assert blobs.get("checkpoints", sha256) == b"whole"


def test_a_missing_blob_and_a_foreign_kind_are_errors(tmp_path: Path) -> None:
    blobs = Blobs(str(tmp_path))
    with pytest.raises(MissingBlob, match="weights/aa/" + "a" * 64):
        blobs.get("weights", "a" * 64)
    with pytest.raises(ValueError, match="provenance"):
        blobs.get("provenance", "a" * 64)
    with pytest.raises(ValueError, match="ftp"):
        Blobs("ftp://example.org/blobs")


def test_a_trajectory_whose_bytes_were_changed_on_disk_is_not_served(served: Served) -> None:
    project = served.project()
    trajectory = served.upload(project, room(0))[0]["id"]
    (path,) = [found for found in (served.settings.data_folder / "blobs").rglob("*") if found.is_file()]
    path.write_bytes(path.read_bytes()[:-1] + b"!")
    answer = served.client.get(f"/trajectories/{trajectory}/content", params={"project": project})
    refused(answer, 500, "corrupt-blob", path.name, hashlib.sha256(path.read_bytes()).hexdigest())
    path.unlink()
    answer = served.client.get(f"/trajectories/{trajectory}/content", params={"project": project})
    refused(answer, 500, "missing-blob", path.name)
