"""Cursor pagination: opaque cursors over a row's sort key."""

import base64
import binascii
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any, TypeVar

from sqlalchemy import BindParameter, ColumnElement, literal, select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from service.errors import InvalidField

R = TypeVar("R")
LONGEST = 1_000  # characters of a cursor


def page(
    session: Session,
    row: type[R],
    where: Sequence[ColumnElement[bool]],
    key: tuple[InstrumentedAttribute[Any], ...],
    cursor: str | None,
    limit: int,
    *,
    newest_first: bool = False,
) -> tuple[list[R], str | None]:
    """Rows after `cursor` in the order of `key`, and the cursor of the next page. Raises InvalidField."""
    statement = select(row).where(*where)
    if cursor is not None:
        after = tuple_(*[_parse(column, value) for column, value in zip(key, _decode(cursor, len(key)), strict=True)])
        statement = statement.where(tuple_(*key) < after if newest_first else tuple_(*key) > after)
    order = [column.desc() if newest_first else column.asc() for column in key]
    rows = list(session.scalars(statement.order_by(*order).limit(limit + 1)))
    more = len(rows) > limit
    return rows[:limit], _encode(rows[limit - 1], key) if more else None


def _encode(row: object, key: tuple[InstrumentedAttribute[Any], ...]) -> str:
    values = [getattr(row, column.key) for column in key]
    text = json.dumps([value if isinstance(value, int | str) else str(value) for value in values])
    return base64.urlsafe_b64encode(text.encode()).decode()


def _decode(cursor: str, length: int) -> list[Any]:
    try:
        values = json.loads(base64.urlsafe_b64decode(cursor[:LONGEST].encode()))
    except (ValueError, RecursionError, binascii.Error) as error:
        raise InvalidField("cursor", cursor, "is not one that this service gave out") from error
    if not isinstance(values, list) or len(values) != length:
        raise InvalidField("cursor", cursor, "is not one of this listing")
    return values


def _parse(column: InstrumentedAttribute[Any], value: Any) -> BindParameter[Any]:
    """The value as its column writes it: inside a tuple nothing else tells the database's form of a time or an id."""
    kind = column.type.python_type
    try:
        if not isinstance(value, kind):
            value = kind.fromisoformat(value) if hasattr(kind, "fromisoformat") else kind(str(value))
        if isinstance(value, datetime):
            value = value.astimezone(UTC)
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidField("cursor", value, "is not one of this listing") from error
    if isinstance(value, int) and abs(value) >= 2**63:  # more than a database's integer holds
        raise InvalidField("cursor", value, "is not one of this listing")
    return literal(value, column.type)
