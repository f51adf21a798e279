"""Which transactions have ended: what a reader that follows a growing table may rely on.

PostgreSQL gives ids when rows are written and shows them when they are committed, so a smaller id may appear after a
larger one. A row that notes its transaction is settled once every transaction below and with that one has ended: read
in the order of transaction and id, up to there, nothing can appear before what was read. SQLite has one writer at a
time, its ids are in that order already.

A database that moves to another server finds its transactions numbered anew. So that the numbers rise all the same, the
one row of `event_epoch` says what is added to them.
"""

from typing import Any

from sqlalchemy import BigInteger
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement

EPOCH = "(SELECT added FROM event_epoch)"


class CurrentTransaction(FunctionElement[int]):
    """The number of the transaction that a row is written in; on SQLite the same for all."""

    type = BigInteger()
    inherit_cache = True


class OldestOpenTransaction(FunctionElement[int]):
    """All transactions below this number have ended."""

    type = BigInteger()
    inherit_cache = True


@compiles(CurrentTransaction)
def _current(element: CurrentTransaction, compiler: Any, **_: Any) -> str:
    return EPOCH


@compiles(CurrentTransaction, "postgresql")
def _current_on_postgresql(element: CurrentTransaction, compiler: Any, **_: Any) -> str:
    return f"(pg_current_xact_id()::text::bigint + {EPOCH})"


@compiles(OldestOpenTransaction)
def _oldest(element: OldestOpenTransaction, compiler: Any, **_: Any) -> str:
    return f"({EPOCH} + 1)"


@compiles(OldestOpenTransaction, "postgresql")
def _oldest_on_postgresql(element: OldestOpenTransaction, compiler: Any, **_: Any) -> str:
    return f"(pg_snapshot_xmin(pg_current_snapshot())::text::bigint + {EPOCH})"
