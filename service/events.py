"""Events: an append-only account of what happened: who, when, what."""

from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from api_schemas.events import Event
from service import origin
from service.store.tables import EventRow


def record(session: Session, project_id: UUID | None, kind: str, data: dict[str, object], now: datetime) -> None:
    """Write an event in the transaction of the change that it tells of; who and on whose request is what is bound."""
    by = origin.current()
    session.add(
        EventRow(
            project_id=project_id,
            kind=kind,
            data=data,
            actor=by.actor,
            correlation=by.correlation,
            created_at=now,
        )
    )


def describe(row: EventRow) -> Event:
    """The event as the API shows it."""
    return Event(
        id=row.id,
        project=row.project_id,
        kind=row.kind,
        data=row.data,
        actor=row.actor,
        correlation=row.correlation,
        created_at=row.created_at,
    )
