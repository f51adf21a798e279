"""Events."""

from sqlalchemy import BigInteger, ColumnElement, case, func, literal, select, update
from sqlalchemy.orm import Session

from service.store.horizon import CurrentTransaction, OldestOpenTransaction
from service.store.tables import EventEpochRow, EventRow

ORDER = (EventRow.transaction, EventRow.id)  # in which they can be followed


def settled() -> ColumnElement[bool]:
    """No event that comes before it in ORDER can still be committed: a reader who goes on behind it misses nothing."""
    return EventRow.transaction < OldestOpenTransaction()


def keep_order(session: Session) -> None:
    """Have what is written from now on come after all that is there, also where another server wrote that."""
    newest = session.scalar(select(func.max(EventRow.transaction))) or 0
    ahead = literal(newest, BigInteger()) - CurrentTransaction()
    session.execute(update(EventEpochRow).values(added=EventEpochRow.added + case((ahead > 0, ahead), else_=0)))
