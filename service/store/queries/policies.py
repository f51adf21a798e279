"""Policies by what is known of them."""

from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.store.queries.inserting import insert
from service.store.tables import PolicyRow


def of_training(session: Session, project_id: UUID, training_id: UUID) -> Sequence[PolicyRow]:
    """The stages that a job has kept so far, in order."""
    these = (PolicyRow.project_id == project_id, PolicyRow.training_id == training_id)
    return session.scalars(select(PolicyRow).where(*these).order_by(PolicyRow.stage)).all()


def of_any_project(session: Session, sha256: str) -> PolicyRow | None:
    """One with these weights, of whichever project."""
    return session.scalars(select(PolicyRow).where(PolicyRow.sha256 == sha256).limit(1)).first()


def copy(session: Session, row: PolicyRow, project_id: UUID, now: datetime) -> None:
    """The same policy in another project, where nothing goes on from it; others may do so at the same time."""
    fields = {column.name: getattr(row, column.name) for column in PolicyRow.__table__.columns}
    own: dict[str, object] = {"project_id": project_id, "state_sha256": None, "created_at": now}
    session.execute(insert(session, PolicyRow).values(**fields | own).on_conflict_do_nothing())
