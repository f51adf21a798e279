"""Segments named in a statement."""

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import ARRAY, ColumnElement, Integer, Select, String, bindparam, func, select, true, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

Segment = tuple[str, int]  # trajectory, start


def among(
    session: Session,
    trajectory: InstrumentedAttribute[str],
    start: InstrumentedAttribute[int],
    segments: Sequence[Segment],
) -> ColumnElement[bool]:
    """The row's segment is one of these; any number of them costs an index look-up each.

    PostgreSQL is sent two arrays: a list of pairs becomes a condition that it tries on every row of the project.
    """
    if session.get_bind().dialect.name != "postgresql":
        return tuple_(trajectory, start).in_(segments)
    names, starts = zip(*segments, strict=True) if segments else ((), ())
    return tuple_(trajectory, start).in_(select(_unnested(names, String()), _unnested(starts, Integer())))


def looked_up(
    session: Session,
    columns: Sequence[InstrumentedAttribute[Any]],
    where: ColumnElement[bool],
    segments: Sequence[Segment],
) -> Select[Any]:
    """`columns`, of which trajectory and start come first, of the one row that each of these segments has, if any.

    On PostgreSQL each segment is looked up by itself. Left to choose, it reads all rows of the project while it has no
    statistics yet, that is in the first minutes of a table that grows fast.
    """
    trajectory, start = columns[:2]
    if session.get_bind().dialect.name != "postgresql":
        return select(*columns).where(where, among(session, trajectory, start, segments))
    names, starts = zip(*segments, strict=True)
    arrays = bindparam(None, list(names), ARRAY(String())), bindparam(None, list(starts), ARRAY(Integer()))
    asked = func.unnest(*arrays).table_valued("trajectory", "start").render_derived()
    one = select(*columns).where(where, trajectory == asked.c.trajectory, start == asked.c.start).limit(1).lateral()
    return select(one).select_from(asked).join(one, true())


def parts(segments: Sequence[Segment]) -> Iterator[Sequence[Segment]]:
    """In parts that a statement takes: databases bound their parameters."""
    for i in range(0, len(segments), 500):
        yield segments[i : i + 500]


def _unnested(values: Sequence[Any], kind: Any) -> ColumnElement[Any]:
    return func.unnest(bindparam(None, list(values), ARRAY(kind)))
