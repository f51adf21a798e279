"""Kept answers."""

from datetime import datetime

from sqlalchemy import delete
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from service.store.tables import IdempotencyRow


def insert_or_find(
    session: Session, caller: str, route: str, key: str, request_sha256: str, now: datetime, expires_at: datetime
) -> IdempotencyRow:
    """The row of this key, made where there is none or only an expired one.

    The insert waits for another transaction that has just inserted the same key; what that one committed is found.
    """
    insert = postgresql.insert if session.get_bind().dialect.name == "postgresql" else sqlite.insert
    values = {"caller": caller, "route": route, "key": key, "request_sha256": request_sha256, "expires_at": expires_at}
    fresh = insert(IdempotencyRow).values(values).on_conflict_do_nothing().returning(IdempotencyRow)
    made = session.scalar(fresh)
    if made is not None:
        return made
    found = session.get(IdempotencyRow, (caller, route, key))
    if found is not None and found.expires_at > now:
        return found
    if found is not None:  # it stands for nothing any more
        session.delete(found)
        session.flush()
    return session.scalars(fresh).one()


def forget_expired(session: Session, now: datetime) -> None:
    """Drop what need not be kept any longer."""
    session.execute(delete(IdempotencyRow).where(IdempotencyRow.expires_at <= now))
