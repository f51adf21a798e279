"""Rounds and model versions."""

from collections.abc import Sequence
from uuid import UUID

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.store.tables import ModelVersionRow, RoundRow


def current_round(session: Session, project_id: UUID) -> RoundRow | None:
    """The round whose models and queue are in use."""
    return session.scalar(select(RoundRow).where(RoundRow.project_id == project_id, RoundRow.status == "current"))


def queued_rounds(session: Session, project_id: UUID) -> Sequence[RoundRow]:
    """Rounds whose job no worker has begun, locked: none begins while they are superseded."""
    statement = select(RoundRow).where(RoundRow.project_id == project_id, RoundRow.status == "queued")
    return session.scalars(statement.with_for_update().execution_options(populate_existing=True)).all()


def last_number(session: Session, project_id: UUID) -> int:
    """Number of the project's youngest round; 0 before the first."""
    return session.scalar(select(func.max(RoundRow.number)).where(RoundRow.project_id == project_id)) or 0


def evaluated_rounds(session: Session, project_id: UUID) -> Sequence[RoundRow]:
    """Rounds with a model error, oldest first."""
    statement = select(RoundRow).where(RoundRow.project_id == project_id, RoundRow.model_error.is_not(None))
    return session.scalars(statement.order_by(RoundRow.number)).all()


def models_of(session: Session, round_id: UUID) -> Sequence[ModelVersionRow]:
    """The networks of a round, members of an ensemble in order."""
    statement = select(ModelVersionRow).where(ModelVersionRow.round_id == round_id)
    return session.scalars(statement.order_by(ModelVersionRow.kind, ModelVersionRow.member)).all()


def previous_world_model(session: Session, row: RoundRow) -> ModelVersionRow | None:
    """The world model of the last round before this one that trained one.

    None where that was another version of the service: its weights cannot be read, and its config has other fields.
    """
    statement = (
        select(ModelVersionRow)
        .join(RoundRow, RoundRow.id == ModelVersionRow.round_id)
        .where(RoundRow.project_id == row.project_id, RoundRow.number < row.number)
        .where(ModelVersionRow.kind == "world_model")
    )
    previous = session.scalar(statement.order_by(RoundRow.number.desc()).limit(1))
    own = next((model for model in models_of(session, row.id) if model.kind == "world_model"), None)
    changed = previous is not None and own is not None and previous.config.keys() != own.config.keys()
    return None if changed else previous


def model_before(session: Session, row: RoundRow, kind: str, member: int) -> ModelVersionRow | None:
    """The network of the last round before this one that was trained to its end and has one of this kind."""
    statement = (
        select(ModelVersionRow)
        .join(RoundRow, RoundRow.id == ModelVersionRow.round_id)
        .where(RoundRow.project_id == row.project_id, RoundRow.number < row.number)
        .where(RoundRow.status.in_(("scoring", "current", "superseded")))
        .where(ModelVersionRow.kind == kind, ModelVersionRow.member == member)
    )
    return session.scalar(statement.order_by(RoundRow.number.desc()).limit(1))


def newest_model(session: Session, project_id: UUID, kind: str) -> ModelVersionRow | None:
    """The youngest network of a kind."""
    statement = select(ModelVersionRow).where(ModelVersionRow.project_id == project_id, ModelVersionRow.kind == kind)
    return session.scalar(statement.order_by(ModelVersionRow.created_at.desc()).limit(1))
