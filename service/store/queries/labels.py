"""Labels of a project."""

from collections.abc import Sequence
from uuid import UUID

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.store.tables import LabelRow


def label_of(session: Session, project_id: UUID, trajectory: str, start: int) -> LabelRow | None:
    """The label of a segment."""
    return session.scalar(
        select(LabelRow).where(
            LabelRow.project_id == project_id, LabelRow.trajectory_id == trajectory, LabelRow.start == start
        )
    )


def labels_up_to(session: Session, project_id: UUID, split: str, watermark: int) -> Sequence[LabelRow]:
    """Labels of a split in the order they were accepted, up to and with `watermark`."""
    statement = select(LabelRow).where(
        LabelRow.project_id == project_id, LabelRow.split == split, LabelRow.watermark <= watermark
    )
    return session.scalars(statement.order_by(LabelRow.watermark)).all()


def label_count(session: Session, project_id: UUID, split: str, watermark: int) -> int:
    """How many labels a round with this watermark sees."""
    statement = select(func.count()).where(
        LabelRow.project_id == project_id, LabelRow.split == split, LabelRow.watermark <= watermark
    )
    return session.scalar(statement) or 0


def labeled_by_trajectory(session: Session, project_id: UUID, trajectories: Sequence[str]) -> dict[str, int]:
    """Number of labels by trajectory."""
    statement = (
        select(LabelRow.trajectory_id, func.count())
        .where(LabelRow.project_id == project_id, LabelRow.trajectory_id.in_(trajectories))
        .group_by(LabelRow.trajectory_id)
    )
    return {row[0]: row[1] for row in session.execute(statement)}
