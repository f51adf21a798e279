"""Which transactions have ended: what a reader that follows a growing table by its ids may rely on.

PostgreSQL gives ids when rows are written and shows them when they are committed, so a smaller id may appear after a
larger one. A row that notes its transaction is settled once every transaction up to that one has ended. SQLite has one
writer at a time and needs none of this.
"""

from typing import Any

from sqlalchemy import BigInteger
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement


class CurrentTransaction(FunctionElement[int]):
    """The number of the transaction that a row is written in; 0 on SQLite."""

    type = BigInteger()
    inherit_cache = True


class OldestOpenTransaction(FunctionElement[int]):
    """All transactions below this number have ended; on SQLite a number above all."""

    type = BigInteger()
    inherit_cache = True


@compiles(CurrentTransaction)
def _current(element: CurrentTransaction, compiler: Any, **_: Any) -> str:
    return "0"


@compiles(CurrentTransaction, "postgresql")
def _current_on_postgresql(element: CurrentTransaction, compiler: Any, **_: Any) -> str:
    return "pg_current_xact_id()::text::bigint"


@compiles(OldestOpenTransaction)
def _oldest(element: OldestOpenTransaction, compiler: Any, **_: Any) -> str:
    return "1"


@compiles(OldestOpenTransaction, "postgresql")
def _oldest_on_postgresql(element: OldestOpenTransaction, compiler: Any, **_: Any) -> str:
    return "pg_snapshot_xmin(pg_current_snapshot())::text::bigint"
