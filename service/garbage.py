"""Blobs that nothing refers to: of uploads that were refused, of training that was superseded.

In two steps, each after a grace period: into the trash, and out of it. A blob that is written anew while it goes to the
trash is found there by whoever asks for it; so no step can lose what a row refers to.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from service.log import get_logger
from service.store.blobs import Blobs, Stored
from service.store.database import Database
from service.store.queries.references import references

log = get_logger("garbage")


@dataclass(frozen=True)
class Collected:
    """What was, or would be, done: into the trash, out of it for good, and back from it."""

    discarded: tuple[Stored, ...]
    forgotten: tuple[Stored, ...]
    taken_back: tuple[Stored, ...]


def collect(
    database: Database, stores: Sequence[Blobs], now: datetime, grace: timedelta, *, dry_run: bool = False
) -> Collected:
    """Look through all stores. A blob younger than `grace` may belong to a transaction that is not committed yet."""
    parts = [_collect(database, store, now - grace, dry_run=dry_run) for store in stores]
    return Collected(
        tuple(blob for part in parts for blob in part.discarded),
        tuple(blob for part in parts for blob in part.forgotten),
        tuple(blob for part in parts for blob in part.taken_back),
    )


def _collect(database: Database, store: Blobs, before: datetime, *, dry_run: bool) -> Collected:
    found, trash = list(store.stored()), list(store.discarded())  # before the rows: what is referred to by then stays
    with database.read() as session:
        needed = set(references(session))
    there = {(blob.kind, blob.sha256) for blob in found}
    gone = Collected(
        tuple(blob for blob in found if (blob.kind, blob.sha256) not in needed and blob.modified < before),
        tuple(blob for blob in trash if (blob.kind, blob.sha256) not in needed and blob.modified < before),
        tuple(blob for blob in trash if (blob.kind, blob.sha256) in needed - there),
    )
    if not dry_run:
        for blob in gone.taken_back:
            store.take_back(blob.kind, blob.sha256)
        for blob in gone.forgotten:
            store.forget(blob.kind, blob.sha256)
        for blob in gone.discarded:
            store.discard(blob.kind, blob.sha256)
            log.info("blob_discarded", kind=blob.kind, sha256=blob.sha256, bytes=blob.bytes)
    return gone
