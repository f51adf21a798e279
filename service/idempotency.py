"""Idempotency: the answer to a request with an Idempotency-Key is kept, in the transaction of what the request did."""

from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy.orm import Session

from api_schemas.errors import InvalidParam
from service.errors import ServiceError
from service.store.queries import idempotency as queries
from service.store.tables import IdempotencyRow


class IdempotencyKeyReused(ServiceError):
    """An Idempotency-Key stands for one request."""

    status_code = 422

    def __init__(self, key: str, route: str) -> None:
        reason = f"was used for another body of {route}"
        super().__init__(
            f"Idempotency-Key: {key!r} {reason}", [InvalidParam(name="Idempotency-Key", reason=reason, value=key)]
        )


@dataclass(frozen=True)
class KeyUse:
    """One use of a key: who sent which request under it. Two callers may use the same key."""

    caller: str
    route: str
    key: str
    request_sha256: str


def begin(session: Session, use: KeyUse, now: datetime, keep: timedelta) -> IdempotencyRow:
    """The kept answer (its `status` is set), or a new row for `finish` to fill or `forget` to remove.

    Where the same key is in use at this moment, this waits for the other's end. Raises IdempotencyKeyReused.
    """
    row = queries.insert_or_find(session, use.caller, use.route, use.key, use.request_sha256, now, now + keep)
    return _checked(row, use)


def find(session: Session, use: KeyUse, now: datetime) -> IdempotencyRow | None:
    """The kept answer, where there is one already; waits for nobody. Raises IdempotencyKeyReused."""
    row = queries.kept(session, use.caller, use.route, use.key, now)
    return None if row is None else _checked(row, use)


def finish(row: IdempotencyRow, status: int, location: str | None, body: str) -> None:
    """Keep the answer."""
    row.status, row.location, row.body = status, location, body


def forget(session: Session, row: IdempotencyRow) -> None:
    """The request changed nothing that a repetition would do twice."""
    session.delete(row)


def _checked(row: IdempotencyRow, use: KeyUse) -> IdempotencyRow:
    if row.request_sha256 != use.request_sha256:
        raise IdempotencyKeyReused(use.key, use.route)
    return row
