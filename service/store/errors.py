"""What stops an upgrade, a copy, a backup or a restore: the command line tells it, no request meets it."""

from service.errors import ServiceError


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
