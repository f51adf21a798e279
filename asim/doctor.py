"""What is wrong with an installation, and what to do about it. It looks and changes nothing."""

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from importlib import import_module
from pathlib import Path

from kombu.exceptions import OperationalError as BrokerError
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from service import canary, keys
from service.carrier import impatient_app
from service.settings import Settings
from service.store.blobs import Blobs
from service.store.database import Database, newest_revision, open_database, revision_of
from service.store.errors import BlobsUnavailable, CorruptBlob, MissingBlob
from service.store.provenance import open_provenance
from service.store.queries import jobs as job_queries
from service.store.queries import pool as pool_queries
from service.store.queries.references import references
from service.store.tables import EventRow, WorkerRow
from workers.simulators.catalog import SIMULATORS

SHOWN = 5  # faults of one kind that are told one by one
SKEW = timedelta(seconds=2)


@dataclass(frozen=True)
class Fault:
    """A sentence about what is wrong, and one about what to do."""

    sentence: str
    advice: str


@dataclass(frozen=True)
class Installation:
    """What is looked at. thorough: every blob is read and its hash checked."""

    settings: Settings
    database: Database
    clock: Callable[[], datetime]
    thorough: bool = True

    @property
    def now(self) -> datetime:
        """This machine's time."""
        return self.clock()

    @property
    def stores(self) -> list[Blobs]:
        """Those that this process may reach; to open a folder that is not there would make it."""
        url = self.settings.resolved_blobs_url()
        blobs = Blobs(url) if _is_there(url) else None
        provenance = open_provenance(self.settings) if _is_there(self.settings.resolved_provenance_url()) else None
        return [store for store in (blobs, provenance) if store is not None]

    @property
    def folders(self) -> list[Path]:
        """Of this machine, that data is written to."""
        urls = (self.settings.resolved_blobs_url(), self.settings.resolved_provenance_url() or "")
        local = [Path(url) for url in urls if url and "://" not in url]
        return [self.settings.data_folder, *local] if self.settings.embedded else local


Check = Callable[[Installation], Iterator[Fault]]


def examine(
    settings: Settings, clock: Callable[[], datetime], *, thorough: bool = True
) -> Iterator[tuple[str, list[Fault]]]:
    """Each check's name with the faults that it found. Without a database of our schema only what needs none."""
    database = open_database(settings.resolved_database_url(), pool_size=2)
    held = Installation(settings, database, clock, thorough)
    try:
        for name, check in FIRST.items():
            faults = _found(check, held)
            yield name, faults
            if name == "database" and faults:
                return
        for name, check in THEN.items():
            yield name, _found(check, held)
    finally:
        database.close()


def _found(check: Check, held: Installation) -> list[Fault]:
    """A check that breaks down is a fault too, and the others go on."""
    faults: list[Fault] = []
    try:
        for each in check(held):
            faults.append(each)
    except Exception as error:  # the boundary: whatever is wrong here is what somebody wants to know
        sentence = f"the check broke down: {type(error).__name__}: {str(error).partition(chr(10))[0]}"
        faults.append(Fault(sentence, "see whether another check names the cause; else it is a defect of asim"))
    return faults


def permissions(held: Installation) -> Iterator[Fault]:
    """Folders that this user cannot write, or that everybody can read."""
    for folder in held.folders:
        if not folder.exists():
            yield Fault(f"folder {folder} is not there", "start asim serve, or name another with --data")
            continue
        state = folder.stat()
        if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
            yield Fault(f"this user may not write to {folder}", f"chown it to the user that runs the service: {folder}")
        if state.st_mode & 0o007 and all(parent.stat().st_mode & 0o001 for parent in folder.absolute().parents):
            mode = f"{state.st_mode & 0o777:o}"
            yield Fault(f"every user of this machine reaches into {folder} (mode {mode})", f"chmod o= {folder}")


def disk(held: Installation) -> Iterator[Fault]:
    """Less room than the service should have."""
    for folder in (folder for folder in held.folders if folder.exists()):
        free = shutil.disk_usage(folder).free
        if free < held.settings.min_free_bytes:
            sentence = f"{folder} has {_size(free)} left, less than {_size(held.settings.min_free_bytes)}"
            yield Fault(sentence, "make room (asim gc removes what nothing refers to), or move the data")


def database(held: Installation) -> Iterator[Fault]:
    """It does not answer, or its schema is of another version."""
    url = held.database.engine.url
    if url.get_backend_name() == "sqlite" and not Path(str(url.database)).exists():
        yield Fault(f"there is no database {url.database}", "start asim serve, or name another with --data")
        return
    try:
        with held.database.engine.connect() as connection:
            found = revision_of(connection)
    except SQLAlchemyError as error:
        sentence = f"the database {url.render_as_string()} does not answer: {str(error).splitlines()[0]}"
        yield Fault(sentence, "start it, or correct ASIM_DATABASE_URL")
        return
    newest = newest_revision()
    if found != newest:
        older = "run asim db upgrade" if found < newest else "install the version of asim that wrote it, or a newer one"
        yield Fault(f"the database has schema {found or 'none'}, this version of asim needs {newest}", older)


def broker(held: Installation) -> Iterator[Fault]:
    """It does not answer."""
    if held.settings.embedded:
        return
    try:
        with impatient_app(held.settings).connection_for_write() as connection:
            connection.ensure_connection(max_retries=1, timeout=5)
    except (BrokerError, OSError) as error:
        address = held.settings.broker_url.rpartition("@")[2]
        yield Fault(f"the broker {address} does not answer: {error}", "start it, or correct ASIM_BROKER_URL")


def clock(held: Installation) -> Iterator[Fault]:
    """The database's clock, and times of rows that are still to come."""
    with held.database.read() as session:
        if held.database.engine.dialect.name == "postgresql":
            before = held.now
            theirs = session.scalars(select(func.clock_timestamp())).one()
            apart = theirs - min(max(theirs, before), held.now)  # 0 where it lies between: the answer took that long
            if abs(apart) > SKEW:
                yield Fault(f"the database server's clock is {_apart(apart)} of this machine's", _SYNCHRONISE)
        for what, column in (("event", EventRow.created_at), ("sign of a worker", WorkerRow.heartbeat_at)):
            newest = session.scalar(select(func.max(column)))
            now = held.now
            if newest is not None and newest > now + SKEW:
                yield Fault(f"the newest {what} is {_apart(newest - now)} of this machine's clock", _SYNCHRONISE)


def blobs(held: Installation) -> Iterator[Fault]:
    """Blobs that rows refer to and that are not there, or not what they were."""
    faults = []
    for store in held.stores:
        try:
            needed = _needed(held, store)
            there = {(blob.kind, blob.sha256) for blob in store.stored()}
            if held.thorough:
                faults += [fault for each in needed & there for fault in _read(store, *each)]
            there |= {(blob.kind, blob.sha256) for blob in store.discarded()}  # whoever asks for it gets it back
            gone = (needed - there) & _needed(held, store)  # not what was replaced meanwhile, such as a checkpoint
            faults += [
                Fault(f"blob {kind}/{sha256} is not in the store", _FROM_BACKUP) for kind, sha256 in sorted(gone)
            ]
        except BlobsUnavailable as error:
            yield Fault(f"a store does not answer: {error.detail}", "start it, or correct ASIM_BLOBS_URL")
    yield from faults[:SHOWN]
    if len(faults) > SHOWN:
        yield Fault(f"{len(faults) - SHOWN} more blobs are missing or damaged", _FROM_BACKUP)


def _needed(held: Installation, store: Blobs) -> set[tuple[str, str]]:
    with held.database.read() as session:
        return {(each.kind, each.sha256) for each in references(session) if each.kind in store.kinds}


def queues(held: Installation) -> Iterator[Fault]:
    """Queues in which nothing was done lately."""
    with held.database.read() as session:
        ages = canary.ages(session, held.now)
        healthy = canary.healthy(session, held.now, held.settings.canary_seconds)
        alive = job_queries.live_workers(session, held.now - canary.WORKER_SILENCE)
    silent = [queue for queue, well in healthy.items() if not well]
    if silent and not alive and held.settings.embedded:
        yield Fault("nobody serves this folder: no runner was heard of lately", "start asim serve")
        return
    for queue in silent:
        age = ages[queue]
        since = "ever" if age is None else f"for {age:.0f} s"
        advice = f"start asim worker --queues {queue}, or see in its log why it does nothing"
        yield Fault(f"nothing was done in the queue {queue} {since}; {alive} workers were heard of lately", advice)


def simulators(held: Installation) -> Iterator[Fault]:
    """Projects whose simulator is not installed here."""
    with held.database.read() as session:
        named = {str(row.environment.get("simulator")): row.name for row in pool_queries.projects_in_order(session)}
    for simulator, project in named.items():
        if simulator == "None":
            continue
        try:
            import_module(SIMULATORS[simulator])
        except (ImportError, KeyError) as error:
            sentence = f"project {project!r} needs the simulator {simulator}, which is not installed here ({error})"
            yield Fault(sentence, "install it (README), or run the worker of the queue label where it is")


def expired_keys(held: Installation) -> Iterator[Fault]:
    """Keys that open nothing any more, and whose holders may wonder why."""
    with held.database.read() as session:
        for key in keys.everyone(session):
            if key.expires_at is not None and key.expires_at <= held.now:
                sentence = f"key {key.id} of {key.name!r} expired at {key.expires_at.isoformat(timespec='seconds')}"
                yield Fault(sentence, f"make another with asim key create, and asim key revoke {key.id}")


FIRST: dict[str, Check] = {"permissions": permissions, "disk": disk, "broker": broker, "database": database}
THEN: dict[str, Check] = {
    "clock": clock,
    "blobs": blobs,
    "queues": queues,
    "simulators": simulators,
    "keys": expired_keys,
}
_SYNCHRONISE = "let a time service (chrony, systemd-timesyncd) set the clocks of all machines"
_FROM_BACKUP = "copy it from a backup (the folder blobs of what asim backup made), under the same name"


def report(found: Sequence[tuple[str, list[Fault]]]) -> list[str]:
    """Lines for a person."""
    lines = []
    for name, faults in found:
        lines += [f"ok     {name}"] if not faults else []
        for fault in faults:
            lines += [f"FAULT  {name}: {fault.sentence}", f"       {fault.advice}"]
    return lines


def _is_there(url: str | None) -> bool:
    return bool(url) and ("://" in str(url) or Path(str(url)).is_dir())


def _read(store: Blobs, kind: str, sha256: str) -> list[Fault]:
    try:
        store.get(kind, sha256)
    except CorruptBlob as error:
        return [Fault(error.detail, _FROM_BACKUP)]
    except MissingBlob:  # a checkpoint that training replaced while we looked
        return []
    return []


def _size(number: int) -> str:
    return f"{number / 2**30:.1f} GiB"


def _apart(difference: timedelta) -> str:
    seconds = difference.total_seconds()
    return f"{abs(seconds):.0f} s {'ahead' if seconds > 0 else 'behind'}"
