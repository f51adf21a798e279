"""Engines and sessions. SQLite writers begin IMMEDIATE: deferred transactions lose updates or fail under contention."""

import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, create_engine, event, make_url
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.orm import Session, sessionmaker
from sqlalchemy.pool import ConnectionPoolEntry

from service.settings import POOL_SIZE
from service.store.errors import NoDatabase
from service.store.queries.events import keep_order

SQLITE_WAITS = 15_000  # milliseconds
WAITS = {"lock_timeout": 15_000, "idle_in_transaction_session_timeout": 30_000}  # milliseconds, on PostgreSQL


@dataclass(frozen=True)
class Database:
    """One database, two kinds of sessions: `write()` commits at its end or rolls back, `read()` never writes."""

    engine: Engine
    writers: sessionmaker[Session]
    readers: sessionmaker[Session]

    @contextmanager
    def write(self) -> Iterator[Session]:
        """A transaction that is committed when the block ends and rolled back when it raises."""
        with self.writers.begin() as session:
            yield session

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A read-only snapshot."""
        with self.readers() as session:
            yield session

    def close(self) -> None:
        """Give back all connections."""
        self.engine.dispose()


def open_database(url: str, pool_size: int = POOL_SIZE) -> Database:
    """Open, without migrating. Threads may share it; processes open their own.

    pool_size: connections at most, opened as they are needed.
    """
    server = {} if url.startswith("sqlite") else {"pool_pre_ping": True, "connect_args": {"connect_timeout": 5}}
    engine = create_engine(url, pool_size=pool_size, max_overflow=0, **server)
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _configure_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
    elif engine.dialect.name == "postgresql":
        event.listen(engine, "connect", _configure_postgresql)
    write_engine = engine.execution_options(asim_write=True)
    return Database(
        engine,
        sessionmaker(write_engine, expire_on_commit=False),
        sessionmaker(engine, expire_on_commit=False, autoflush=False),
    )


def migrate(url: str, revision: str = "head") -> None:
    """Upgrade the schema to `revision`; at the newest, what is written from now on comes after all that is there."""
    config = _alembic()
    config.attributes["url"] = url
    command.upgrade(config, revision)
    if revision == "head":
        database = open_database(url)
        with database.write() as session:
            keep_order(session)
        database.close()


def _alembic() -> Config:
    config = Config()
    config.set_main_option("script_location", "service.store:migrations")
    config.set_main_option("path_separator", "os")
    return config


def downgrade(url: str, revision: str) -> None:
    """Take the schema back to `revision`."""
    config = _alembic()
    config.attributes["url"] = url
    command.downgrade(config, revision)


def check_newest(url: str) -> None:
    """Raises NoDatabase where it is missing (to open a SQLite file would make it) or of another schema."""
    named = make_url(url)
    if named.get_backend_name() == "sqlite" and not Path(str(named.database)).exists():
        raise NoDatabase(named.render_as_string(), "is not there")
    database = open_database(url, pool_size=1)
    try:
        with database.engine.connect() as connection:
            found = revision_of(connection)
    finally:
        database.close()
    if found != newest_revision():
        reason = f"has schema {found or 'none'}, this version of asim needs {newest_revision()}: asim db upgrade"
        raise NoDatabase(named.render_as_string(), reason)


def knows(revision: str) -> bool:
    """Whether there is such a migration."""
    return revision in {each.revision for each in ScriptDirectory.from_config(_alembic()).walk_revisions()}


def revision_of(connection: Connection) -> str:
    """Which migration the database is at; "" before the first."""
    return MigrationContext.configure(connection).get_current_revision() or ""


def newest_revision() -> str:
    """Which migration this version of the service needs."""
    return ScriptDirectory.from_config(_alembic()).get_current_head() or ""


def _configure_sqlite(connection: DBAPIConnection, _: ConnectionPoolEntry) -> None:
    if not isinstance(connection, sqlite3.Connection):
        raise TypeError(f"expected a sqlite3 connection, got {type(connection).__name__}")
    connection.isolation_level = None  # SQLAlchemy's begin event below says BEGIN, not the driver
    for pragma in (f"busy_timeout={SQLITE_WAITS}", "synchronous=NORMAL", "foreign_keys=ON"):
        connection.execute(f"PRAGMA {pragma}")
    _write_ahead(connection)


def _write_ahead(connection: sqlite3.Connection) -> None:
    """A new file's first change to the write-ahead log needs it alone, and for that SQLite itself does not wait."""
    deadline = time.monotonic() + SQLITE_WAITS / 1000
    while not _has_write_ahead(connection, last_try=time.monotonic() > deadline):
        time.sleep(0.02)


def _has_write_ahead(connection: sqlite3.Connection, last_try: bool) -> bool:
    """False where another process holds the file. Raises sqlite3.OperationalError for other faults, and at the end."""
    try:
        connection.execute("PRAGMA journal_mode=WAL")
    except sqlite3.OperationalError as error:
        if last_try or error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
            raise
        return False
    return True


def _configure_postgresql(connection: DBAPIConnection, _: ConnectionPoolEntry) -> None:
    """Nobody waits for ever: for a row that another holds, or because a frozen process sits on an open transaction.

    Nor for a compiler: on tables without statistics yet PostgreSQL takes short statements for long ones.
    """
    autocommit = connection.autocommit
    connection.autocommit = True  # else the pool's first rollback takes the settings back
    for name, milliseconds in WAITS.items():
        connection.cursor().execute(f"SET {name} = {milliseconds}")
    connection.cursor().execute("SET jit = off")
    connection.autocommit = autocommit


def _begin_sqlite(connection: Connection) -> None:
    write = connection.get_execution_options().get("asim_write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")
