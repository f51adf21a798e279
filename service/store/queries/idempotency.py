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
    named = (IdempotencyRow.caller == caller, IdempotencyRow.route == route, IdempotencyRow.key == key)
    session.execute(delete(IdempotencyRow).where(*named, IdempotencyRow.expires_at <= now))
    insert = postgresql.insert if session.get_bind().dialect.name == "postgresql" else sqlite.insert
    values = {
        "caller": caller,
        "route": route,
        "key": key,
        "request_sha256": request_sha256,
        "expires_at": expires_at,
    }
    session.execute(insert(IdempotencyRow).values(values).on_conflict_do_nothing())
    return session.get_one(IdempotencyRow, (caller, route, key))


def forget_expired(session: Session, now: datetime) -> None:
    """Drop what need not be kept any longer."""
    session.execute(delete(IdempotencyRow).where(IdempotencyRow.expires_at <= now))
