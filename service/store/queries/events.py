"""Events."""

from datetime import datetime, timedelta

from sqlalchemy import ColumnElement, or_

from service.store.horizon import OldestOpenTransaction
from service.store.tables import EventRow

ALWAYS_SETTLED = timedelta(hours=1)  # no transaction is open for so long; and a restored database numbers them anew


def settled(now: datetime) -> ColumnElement[bool]:
    """No event with a smaller id can still be committed: a reader that goes on behind this one misses nothing."""
    return or_(EventRow.transaction < OldestOpenTransaction(), EventRow.created_at < now - ALWAYS_SETTLED)
