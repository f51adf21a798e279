"""All rows of a database to files and back, between databases of either kind.

A file a table: JSON lines, compressed; the first names the columns. Rows are read in one snapshot and written in one
transaction.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any
from uuid import UUID

import zstandard
from sqlalchemy import Connection, MetaData, Table, delete, func, insert, inspect, make_url, select, text
from sqlalchemy.orm import Session

import service.store.tables  # noqa: F401  # its rows are what the metadata holds
from service.store.columns import Row
from service.store.database import check_newest, downgrade, knows, migrate, open_database, revision_of
from service.store.errors import NotEmpty, UnreadableBackup
from service.store.queries.events import keep_order

BATCH = 1000  # rows written at once
SUFFIX = ".jsonl.zst"
FIXED = "event_epoch"  # a table whose one row every database has
TABLES = {table.name: table for table in Row.metadata.sorted_tables}  # what refers to a table comes after it
Rows = Iterator[Sequence[Any]]


@contextmanager
def snapshot(url: str) -> Iterator[Connection]:
    """A connection that sees one moment, however long it reads."""
    level = {} if url.startswith("sqlite") else {"isolation_level": "REPEATABLE READ"}
    with closing(open_database(url, pool_size=1)) as database, database.engine.connect() as connection:
        yield connection.execution_options(**level)


def dump(connection: Connection, folder: Path) -> dict[str, int]:
    """Every table to a file in the folder; rows by table."""
    counts = {}
    for table in TABLES.values():
        with zstandard.open(folder / f"{table.name}{SUFFIX}", "wt", encoding="utf-8") as file:
            file.write(json.dumps([column.name for column in table.columns]) + "\n")
            counts[table.name] = 0
            for row in _rows(connection, table):
                file.write(json.dumps([_plain(value) for value in row]) + "\n")
                counts[table.name] += 1
    return counts


def load(folder: Path, url: str, revision: str, counts: Mapping[str, int]) -> None:
    """Files of that schema into an empty database, which is then brought up to date.

    counts: rows by table. Raises NotEmpty, and UnreadableBackup where a file is not what `dump` wrote.
    """
    _make_private(url)
    _bring_to(url, revision)
    with _written(url) as (connection, tables):
        for name in (name for name in tables if name in counts):
            columns, rows = _read(folder / f"{name}{SUFFIX}")
            written = _write(connection, tables[name], columns, rows)
            if written != counts[name]:
                raise UnreadableBackup(name, f"has {written} rows, its manifest tells of {counts[name]}")
    migrate(url)


def _make_private(url: str) -> None:
    """A new SQLite file is this user's alone: hashes of keys and tokens of leases are in it."""
    named = make_url(url)
    if named.get_backend_name() == "sqlite" and named.database:
        Path(named.database).touch(mode=0o600)


def _bring_to(url: str, revision: str) -> None:
    """An empty database to the schema that the rows are of, so that its migrations move them. Raises NotEmpty."""
    if not knows(revision):
        raise UnreadableBackup(revision, "is a schema of a newer version of asim")
    migrate(url, revision)
    with closing(open_database(url, pool_size=1)) as database, database.engine.connect() as connection:
        _check_empty(connection)
        found = revision_of(connection)
    if found != revision:  # it was newer
        downgrade(url, revision)


def copy(source: str, target: str) -> dict[str, int]:
    """All rows of one database into another, empty one; rows by table. Raises NotEmpty, NoDatabase."""
    check_newest(source)
    _make_private(target)
    migrate(target)
    counts = {}
    with snapshot(source) as reading, _written(target) as (writing, _):
        for table in TABLES.values():
            columns = [column.name for column in table.columns]
            counts[table.name] = _write(writing, table, columns, _rows(reading, table))
    return counts


def _rows(connection: Connection, table: Table) -> Rows:
    statement = select(table).order_by(*table.primary_key.columns)
    yield from connection.execution_options(stream_results=True).execute(statement).yield_per(BATCH)


@contextmanager
def _written(url: str) -> Iterator[tuple[Connection, dict[str, Table]]]:
    """A transaction on an empty database, and its tables as they are there: an older schema has fewer columns."""
    with closing(open_database(url, pool_size=1)) as database, database.write() as session:
        connection = session.connection()
        _check_empty(connection)
        there = set(inspect(connection).get_table_names())
        tables = {name: _as_it_is(connection, table) for name, table in TABLES.items() if name in there}
        connection.execute(delete(tables[FIXED]))
        yield connection, tables
        _count_on(session, tables.values())
        keep_order(session)


def _check_empty(connection: Connection) -> None:
    for name in inspect(connection).get_table_names():
        if name in TABLES and name != FIXED and connection.scalar(select(func.count()).select_from(text(name))):
            raise NotEmpty(name)


def _as_it_is(connection: Connection, table: Table) -> Table:
    """Our types for the columns that are there; columns of ours that are not there yet are left out."""
    there = [column["name"] for column in inspect(connection).get_columns(table.name)]
    columns = [column._copy() for column in table.columns if column.name in there]
    return Table(table.name, MetaData(), *columns)


def _read(path: Path) -> tuple[list[str], Rows]:
    lines = _lines(path)
    return next(lines), lines


def _lines(path: Path) -> Iterator[Any]:
    try:
        with zstandard.open(path, "rt", encoding="utf-8") as file:
            for line in file:
                yield json.loads(line)
    except (zstandard.ZstdError, ValueError) as error:
        raise UnreadableBackup(path.name, str(error)) from error


def _write(connection: Connection, table: Table, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> int:
    """In batches; how many. A column that the table does not have must be empty."""
    unknown = sorted(set(columns) - set(table.columns.keys()))
    if unknown:
        raise UnreadableBackup(table.name, f"has the columns {', '.join(unknown)}, which its schema does not know")
    kinds = [table.columns[name].type.python_type for name in columns]
    values = (dict(zip(columns, map(_typed, kinds, row), strict=True)) for row in rows)
    count = 0
    while batch := list(islice(values, BATCH)):
        connection.execute(insert(table), batch)
        count += len(batch)
    return count


def _count_on(session: Session, tables: Iterable[Table]) -> None:
    """PostgreSQL numbers new rows from a counter that knows nothing of the rows that were written with a number."""
    if session.get_bind().dialect.name != "postgresql":
        return
    for table in tables:
        for column in table.primary_key.columns:
            sequence = session.scalar(
                text("SELECT pg_get_serial_sequence(:t, :c)"), {"t": table.name, "c": column.name}
            )
            highest = session.scalar(select(func.max(column))) if sequence else None
            if highest is not None:
                session.execute(text("SELECT setval(:name, :highest)"), {"name": sequence, "highest": highest})


def _plain(value: object) -> object:
    if isinstance(value, datetime):
        return value.isoformat()
    return str(value) if isinstance(value, UUID) else value


def _typed(kind: type, value: Any) -> Any:
    """The value as its column takes it, from JSON or from another database."""
    if value is None or isinstance(value, kind):
        return value
    if kind is datetime:
        return datetime.fromisoformat(value)
    return UUID(value) if kind is UUID else value
