"""Labels of a project."""

from collections.abc import Sequence
from uuid import UUID

import sqlalchemy
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.store.queries.segments import Segment, among, parts
from service.store.tables import LabelRow


def labels_of(session: Session, project_id: UUID, segments: Sequence[Segment]) -> dict[Segment, LabelRow]:
    """Labels by segment, of those that have one."""
    found: dict[Segment, LabelRow] = {}
    for some in parts(segments):
        named = among(session, LabelRow.trajectory_id, LabelRow.start, some)
        rows = session.scalars(select(LabelRow).where(LabelRow.project_id == project_id, named))
        found |= {(row.trajectory_id, row.start): row for row in rows}
    return found


def insert(session: Session, rows: Sequence[LabelRow]) -> None:
    """Write new labels; a third of the time that the unit of work takes for as many objects."""
    columns = [column.key for column in LabelRow.__table__.columns]
    values = [{column: getattr(row, column) for column in columns} for row in rows]
    session.execute(sqlalchemy.insert(LabelRow), values)


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
