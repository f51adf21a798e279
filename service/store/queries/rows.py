"""One row by its key."""

from typing import TypeVar

from sqlalchemy.orm import Session

R = TypeVar("R")


def get(session: Session, row: type[R], key: object, *, lock: bool = False) -> R | None:
    """The row, on demand locked where the database locks rows, and then read anew.

    Without that a row that this session had read before would keep its old values under the lock. What is not written
    yet is written first: reading anew would undo it. The lock lets others write rows that refer to this one.
    """
    if not lock:
        return session.get(row, key)
    session.flush()
    return session.get(row, key, with_for_update={"key_share": True}, populate_existing=True)
