"""Blobs by content hash, on a folder or an S3-compatible store through obstore.

This store holds observations, weights, scores and checkpoints. What may not be seen in training is in another, with a
root of its own: service.store.provenance.

An S3 store takes endpoint, region and credentials from the AWS_* variables that every S3 program reads (README,
Settings), so that keys are in no URL and no log.
"""

import hashlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from obstore.exceptions import AlreadyExistsError, BaseError
from obstore.store import LocalStore, MemoryStore, S3Store, from_url

from service.log import get_logger
from service.store.errors import BlobsUnavailable, CorruptBlob, MissingBlob

if TYPE_CHECKING:
    from obstore.store import RetryConfig

log = get_logger("store")
# obstore's own would keep a request waiting for three minutes; here who asks is told soon, and asks again.
RETRIES: "RetryConfig" = {"max_retries": 3, "retry_timeout": timedelta(seconds=10)}


NAME = re.compile(r"(?P<kind>[a-z]+)/[0-9a-f]{2}/(?P<sha256>[0-9a-f]{64})$")
TRASH = "trash"  # first part of the key of what was discarded


@dataclass(frozen=True)
class Stored:
    """A blob as a listing shows it."""

    kind: str
    sha256: str
    bytes: int
    modified: datetime


class Blobs:
    """Immutable bytes. `kind` is the first part of the key, for people who look into the store."""

    kinds: tuple[str, ...] = ("trajectories", "weights", "scores", "checkpoints")

    def __init__(self, url: str) -> None:
        self._store = _open_store(url)

    def put(self, kind: str, data: bytes) -> str:
        """Store `data`, once; returns its sha256. Putting the same bytes again changes nothing.

        Raises BlobsUnavailable.
        """
        sha256 = hashlib.sha256(data).hexdigest()
        key = self._key(kind, sha256)
        with _reached(key):
            try:
                self._store.put(key, data, mode="create")
            except AlreadyExistsError:
                self._mend(kind, sha256, data)
            except NotImplementedError:  # AWS_CONDITIONAL_PUT=disabled: the same bytes over the same bytes do no harm
                self._store.put(key, data, mode="overwrite")
        return sha256

    def get(self, kind: str, sha256: str) -> bytes:
        """The bytes, checked. Raises MissingBlob, CorruptBlob and BlobsUnavailable."""
        key = self._key(kind, sha256)
        with _reached(key):
            try:
                data = bytes(self._store.get(key).bytes())
            except FileNotFoundError as error:
                data = self._taken_back(key, error)
        found = hashlib.sha256(data).hexdigest()
        if found != sha256:
            raise CorruptBlob(key, sha256, found)
        return data

    def delete(self, kind: str, sha256: str) -> None:
        """Remove the blob. One that is gone already is no error: whoever removes it may be asked to do so again.

        Raises BlobsUnavailable.
        """
        key = self._key(kind, sha256)
        with _reached(key):
            try:
                self._store.delete(key)
            except FileNotFoundError:  # a folder says so, S3 does not
                return

    def stored(self) -> Iterator[Stored]:
        """All blobs that are there, in no order. Raises BlobsUnavailable."""
        for kind in self.kinds:
            yield from self._listed(kind)

    def discarded(self) -> Iterator[Stored]:
        """What is in the trash; `modified` is when it went there. Raises BlobsUnavailable."""
        for kind in self.kinds:
            yield from self._listed(f"{TRASH}/{kind}")

    def discard(self, kind: str, sha256: str) -> None:
        """Move a blob to the trash, from which `get` takes it back for whoever still asks. Raises BlobsUnavailable."""
        key = self._key(kind, sha256)
        with _reached(key):
            try:
                data = self._store.get(key).bytes()
            except FileNotFoundError:  # somebody was quicker
                return
            self._store.put(f"{TRASH}/{key}", data, mode="overwrite")
        self.delete(kind, sha256)

    def forget(self, kind: str, sha256: str) -> None:
        """Remove what was discarded, for good. Raises BlobsUnavailable."""
        key = f"{TRASH}/{self._key(kind, sha256)}"
        with _reached(key):
            self._store.delete(key)

    def take_back(self, kind: str, sha256: str) -> None:
        """Out of the trash again. Raises MissingBlob, CorruptBlob and BlobsUnavailable."""
        self.get(kind, sha256)
        self.forget(kind, sha256)

    def reachable(self) -> bool:
        """True where the store answers a listing."""
        if isinstance(self._store, LocalStore) and not Path(str(self._store.prefix)).is_dir():
            return False
        try:
            next(iter(self._store.list(chunk_size=1)), None)
        except (BaseError, OSError) as error:
            log.warning("blobs_unreachable", error=_sentence(error))
            return False
        return True

    def _taken_back(self, key: str, error: FileNotFoundError) -> bytes:
        """A blob that was discarded and is asked for: it was no garbage after all."""
        try:
            data = bytes(self._store.get(f"{TRASH}/{key}").bytes())
        except FileNotFoundError:
            raise MissingBlob(key) from error
        self._store.put(key, data, mode="overwrite")
        log.warning("blob_taken_back", key=key)
        return data

    def _listed(self, prefix: str) -> Iterator[Stored]:
        with _reached(prefix):
            for chunk in self._store.list(prefix):
                for found in chunk:
                    named = NAME.search(found["path"])
                    if named:  # else somebody put it there
                        yield Stored(named["kind"], named["sha256"], found["size"], found["last_modified"])

    def _mend(self, kind: str, sha256: str, data: bytes) -> None:
        """An object of this name may be torn (a crash of an older store, a bad disk): write it again if it is."""
        try:
            self.get(kind, sha256)
        except (CorruptBlob, MissingBlob):  # missing: somebody deleted it just now
            self._store.put(self._key(kind, sha256), data, mode="overwrite")

    def _key(self, kind: str, sha256: str) -> str:
        if kind not in self.kinds:
            raise ValueError(f"kind: {kind!r} is not one of {self.kinds}")
        return f"{kind}/{sha256[:2]}/{sha256}"


@contextmanager
def _reached(key: str) -> Iterator[None]:
    """Whatever keeps the store from answering (network, credentials, a full disk, no bucket) is one kind of error."""
    try:
        yield
    except (BaseError, OSError) as error:
        log.warning("blobs_unavailable", key=key, error=_sentence(error))
        raise BlobsUnavailable(key, _sentence(error)) from error


def _sentence(error: Exception) -> str:
    """obstore's first line; below it are its data structures."""
    return str(error).partition("\n")[0][:500]


def _open_store(url: str) -> LocalStore | S3Store | MemoryStore:
    if url.startswith("s3://"):
        return S3Store.from_url(url, retry_config=RETRIES)  # client_options would hide AWS_ALLOW_HTTP and the like
    if "://" not in url:
        Path(url).mkdir(parents=True, exist_ok=True)
        return LocalStore(prefix=url)
    store = from_url(url) if url.startswith(("file://", "memory://")) else None
    if not isinstance(store, LocalStore | MemoryStore):
        raise ValueError(f"blobs_url: {url!r} is neither a folder nor s3://")
    return store
