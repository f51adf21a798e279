"""INSERT with ON CONFLICT, which each database has in a dialect of its own."""

from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from service.store.columns import Row


def insert(session: Session, row: type[Row]) -> postgresql.Insert | sqlite.Insert:
    """An INSERT of the session's database that can be told what to do where the row is there already."""
    return postgresql.insert(row) if session.get_bind().dialect.name == "postgresql" else sqlite.insert(row)
