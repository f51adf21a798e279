"""Kept answers."""

from datetime import datetime

from sqlalchemy import ColumnElement, delete, select
from sqlalchemy.orm import Session

from service.store.errors import KeyBusy
from service.store.queries.inserting import insert
from service.store.tables import IdempotencyRow

ATTEMPTS = 10


def insert_or_find(
    session: Session, caller: str, route: str, key: str, request_sha256: str, now: datetime, expires_at: datetime
) -> IdempotencyRow:
    """The row of this key, made where there is none or only an expired one.

    The insert waits for another transaction that has just inserted the same key; what that one committed is found,
    by a statement of its own and so a snapshot of its own. It may be gone by then: expired, and dropped by the reaper
    or by another request with the same key, whose fresh row the next insert waits for. So it is tried more than once.
    Raises KeyBusy.
    """
    values = {"caller": caller, "route": route, "key": key, "request_sha256": request_sha256, "expires_at": expires_at}
    fresh = insert(session, IdempotencyRow).values(values).on_conflict_do_nothing().returning(IdempotencyRow)
    for _ in range(ATTEMPTS):
        made = session.scalar(fresh)
        if made is not None:
            return made
        found = kept(session, caller, route, key, now)
        if found is not None:
            return found
        expired = delete(IdempotencyRow).where(IdempotencyRow.expires_at <= now, *_named(caller, route, key))
        session.execute(expired)  # it stands for nothing any more
    raise KeyBusy(key)


def kept(session: Session, caller: str, route: str, key: str, now: datetime) -> IdempotencyRow | None:
    """The row of this key, unless it has expired; of another transaction's only what it has committed."""
    live = (IdempotencyRow.expires_at > now, *_named(caller, route, key))
    return session.scalar(select(IdempotencyRow).where(*live).execution_options(populate_existing=True))


def forget_expired(session: Session, now: datetime) -> None:
    """Drop what need not be kept any longer."""
    session.execute(delete(IdempotencyRow).where(IdempotencyRow.expires_at <= now))


def _named(caller: str, route: str, key: str) -> tuple[ColumnElement[bool], ...]:
    return (IdempotencyRow.caller == caller, IdempotencyRow.route == route, IdempotencyRow.key == key)
