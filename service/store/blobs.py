"""Blobs by content hash, on a folder or an S3-compatible store through obstore.

This store holds observations, weights, scores and checkpoints. What may not be seen in training is in another, with a
root of its own: service.store.provenance.
"""

import hashlib
from pathlib import Path

from obstore.exceptions import AlreadyExistsError, BaseError
from obstore.store import LocalStore, MemoryStore, S3Store, from_url

from service.errors import CorruptBlob, MissingBlob
from service.log import get_logger

log = get_logger("store")


class Blobs:
    """Immutable bytes. `kind` is the first part of the key, for people who look into the store."""

    kinds: tuple[str, ...] = ("trajectories", "weights", "scores", "checkpoints")

    def __init__(self, url: str) -> None:
        self._store = _open_store(url)

    def put(self, kind: str, data: bytes) -> str:
        """Store `data`, once; returns its sha256. Putting the same bytes again changes nothing."""
        sha256 = hashlib.sha256(data).hexdigest()
        try:
            self._store.put(self._key(kind, sha256), data, mode="create")
        except AlreadyExistsError:
            self._mend(kind, sha256, data)
        return sha256

    def get(self, kind: str, sha256: str) -> bytes:
        """The bytes, checked. Raises MissingBlob and CorruptBlob."""
        key = self._key(kind, sha256)
        try:
            data = bytes(self._store.get(key).bytes())
        except FileNotFoundError as error:
            raise MissingBlob(key) from error
        found = hashlib.sha256(data).hexdigest()
        if found != sha256:
            raise CorruptBlob(key, sha256, found)
        return data

    def reachable(self) -> bool:
        """True where the store answers a listing."""
        if isinstance(self._store, LocalStore) and not Path(str(self._store.prefix)).is_dir():
            return False
        try:
            next(iter(self._store.list(chunk_size=1)), None)
        except (BaseError, OSError) as error:
            log.warning("blobs_unreachable", error=str(error))
            return False
        return True

    def _mend(self, kind: str, sha256: str, data: bytes) -> None:
        """An object of this name may be torn (a crash of an older store, a bad disk): write it again if it is."""
        try:
            self.get(kind, sha256)
        except CorruptBlob:
            self._store.put(self._key(kind, sha256), data, mode="overwrite")

    def _key(self, kind: str, sha256: str) -> str:
        if kind not in self.kinds:
            raise ValueError(f"kind: {kind!r} is not one of {self.kinds}")
        return f"{kind}/{sha256[:2]}/{sha256}"


def _open_store(url: str) -> LocalStore | S3Store | MemoryStore:
    if "://" not in url:
        Path(url).mkdir(parents=True, exist_ok=True)
        return LocalStore(prefix=url)
    store = from_url(url) if url.startswith(("s3://", "file://", "memory://")) else None
    if not isinstance(store, LocalStore | S3Store | MemoryStore):
        raise ValueError(f"blobs_url: {url!r} is neither a folder nor s3://")
    return store
