"""What the store does not hold, cannot read or cannot do.

What stops an upgrade, a copy, a backup or a restore is told by the command line; no request meets it.
"""

from service.errors import LONGEST, RETRY_SOON, ServiceError


class NoDatabase(ServiceError):
    """There is no database, or it is of another version."""

    def __init__(self, url: str, reason: str) -> None:
        super().__init__(f"the database {url} {reason}")


class NotEmpty(ServiceError):
    """Rows can be written to an empty database only."""

    def __init__(self, table: str) -> None:
        super().__init__(f"the database holds rows of {table} already; name one that is empty, or new")


class BackupExists(ServiceError):
    """A backup does not write over another."""

    def __init__(self, folder: str) -> None:
        super().__init__(f"{folder} is not empty; name a folder that is not there yet")


class UnreadableBackup(ServiceError):
    """A backup is damaged, or is none."""

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(f"{name} {reason}; no row was restored")


class ForeignFile(ServiceError):
    """A file is truncated or of another format."""

    status_code = 400

    def __init__(self, source: str, reason: str) -> None:
        super().__init__(f"{source}: {reason}")


class CorruptBlob(ServiceError):
    """A stored blob does not match its hash."""

    status_code = 500

    def __init__(self, key: str, expected: str, found: str) -> None:
        super().__init__(f"blob {key} should have the hash {expected}, its bytes have {found}")


class MissingBlob(ServiceError):
    """A blob that a row refers to is not in the store."""

    status_code = 500

    def __init__(self, key: str) -> None:
        super().__init__(f"blob {key} is not in the store")


class BlobsUnavailable(ServiceError):
    """The blob store is unavailable."""

    status_code = 503
    headers = RETRY_SOON

    def __init__(self, key: str, reason: str) -> None:
        super().__init__(f"blob {key}: its store did not do what was asked; nothing was stored, try again: {reason}")


class KeyBusy(ServiceError):
    """Too many requests use this Idempotency-Key at this moment."""

    status_code = 503
    headers = RETRY_SOON

    def __init__(self, key: str) -> None:
        super().__init__(
            f"Idempotency-Key {key[:LONGEST]!r} is in use by other requests; nothing was stored, try again"
        )
