"""Segments named in a statement."""

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import ARRAY, ColumnElement, Integer, String, bindparam, func, select, tuple_
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


def parts(segments: Sequence[Segment]) -> Iterator[Sequence[Segment]]:
    """In parts that a statement takes: databases bound their parameters."""
    for i in range(0, len(segments), 500):
        yield segments[i : i + 500]


def _unnested(values: Sequence[Any], kind: Any) -> ColumnElement[Any]:
    return func.unnest(bindparam(None, list(values), ARRAY(kind)))
