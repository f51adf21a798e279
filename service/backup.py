"""A backup: a folder with all rows of one moment and the blobs that they refer to, checked by hash.

It is made while the service works. Restored it is a service that was killed at that moment: what it had acknowledged
until then is there.
"""

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

from pydantic import ValidationError
from sqlalchemy.orm import Session

from api_schemas.base import Schema, Timestamp
from service.store import transfer
from service.store.blobs import Blobs
from service.store.database import revision_of
from service.store.errors import BackupExists, CorruptBlob, MissingBlob, UnreadableBackup
from service.store.provenance import ProvenanceBlobs
from service.store.queries.references import PROVENANCE, Reference, references

MANIFEST = "manifest.json"
# Training replaces and deletes them all the time; one that is gone is a job that starts anew.
PASSING = ("checkpoints", "trainings")


class TableFile(Schema):
    """Rows of a table, and the hash of its file."""

    rows: int
    sha256: str


class Manifest(Schema):
    """What a backup holds. `missing` blobs were not in the stores, or not whole, when it was made."""

    version: str
    revision: str
    created_at: Timestamp
    tables: dict[str, TableFile]
    blobs: dict[str, int]
    missing: list[str]


def backup(url: str, stores: Iterable[Blobs], folder: Path, now: datetime) -> Manifest:
    """Into a folder that is not there yet. Raises BackupExists, BlobsUnavailable."""
    if folder.exists() and any(folder.iterdir()):
        raise BackupExists(str(folder))
    with _unfinished(folder) as unfinished:
        manifest = _write(url, stores, unfinished, now)
        if folder.exists():
            folder.rmdir()
        unfinished.rename(folder)
    return manifest


def _write(url: str, stores: Iterable[Blobs], unfinished: Path, now: datetime) -> Manifest:
    tables = unfinished / "tables"
    tables.mkdir()
    with transfer.snapshot(url) as connection:
        revision = revision_of(connection)
        counts = transfer.dump(connection, tables)
        needed = list(references(Session(connection)))
    copied, missing = _copy_blobs(needed, list(stores), _stores(unfinished))
    manifest = Manifest(
        version=version("asim"),
        revision=revision,
        created_at=now,
        tables={name: TableFile(rows=rows, sha256=_sha256(_file(tables, name))) for name, rows in counts.items()},
        blobs=copied,
        missing=missing,
    )
    (unfinished / MANIFEST).write_text(manifest.model_dump_json(indent=2))
    return manifest


@contextmanager
def _unfinished(folder: Path) -> Iterator[Path]:
    """A new folder beside it, this user's alone: there are keys' hashes, tokens and simulator states in a backup."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    made = Path(mkdtemp(prefix=f"{folder.name}.unfinished-", dir=folder.parent))
    try:
        yield made
    finally:
        rmtree(made, ignore_errors=True)  # it is gone where it was renamed


def restore(folder: Path, url: str, stores: Iterable[Blobs]) -> Manifest:
    """Into an empty database: blobs first, then all rows at once.

    Raises UnreadableBackup, NotEmpty, BlobsUnavailable; then no row was written, and no blob that a row refers to.
    """
    manifest = read_manifest(folder)
    for name, table in manifest.tables.items():
        path = _file(folder / "tables", name)
        if not path.exists() or _sha256(path) != table.sha256:
            raise UnreadableBackup(path.name, "is not the file that the manifest tells of")
    kept = [Reference(blob.kind, blob.sha256) for store in _stores(folder) for blob in store.stored()]
    copied, damaged = _copy_blobs(kept, _stores(folder), list(stores))
    if damaged or copied != manifest.blobs:
        raise UnreadableBackup(str(folder), f"holds {copied} whole blobs, its manifest tells of {manifest.blobs}")
    transfer.load(
        folder / "tables", url, manifest.revision, {name: each.rows for name, each in manifest.tables.items()}
    )
    return manifest


def read_manifest(folder: Path) -> Manifest:
    """Raises UnreadableBackup."""
    try:
        return Manifest.model_validate_json((folder / MANIFEST).read_bytes())
    except (OSError, ValidationError) as error:
        raise UnreadableBackup(str(folder), f"has no readable {MANIFEST}") from error


def _stores(folder: Path) -> list[Blobs]:
    return [Blobs(str(folder / "blobs")), ProvenanceBlobs(str(folder / PROVENANCE))]


def _copy_blobs(
    needed: Iterable[Reference], sources: list[Blobs], targets: list[Blobs]
) -> tuple[dict[str, int], list[str]]:
    """How many of each kind, and those that were not there or not whole."""
    copied, missing = dict[str, int](), list[str]()
    for kind, sha256 in needed:
        source, target = (next((one for one in stores if kind in one.kinds), None) for stores in (sources, targets))
        if source is None or target is None:  # the provenance store is out of this process's reach
            missing.append(f"{kind}/{sha256}")
            continue
        try:
            target.put(kind, source.get(kind, sha256))
        except (CorruptBlob, MissingBlob):
            missing += [] if kind in PASSING else [f"{kind}/{sha256}"]
        else:
            copied[kind] = copied.get(kind, 0) + 1
    return copied, missing


def _file(folder: Path, table: str) -> Path:
    return folder / f"{table}{transfer.SUFFIX}"


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
