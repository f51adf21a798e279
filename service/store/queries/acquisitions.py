"""Scorings, their queues, and claims on segments."""

from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

from sqlalchemy import and_, delete, func, or_, select, tuple_, update
from sqlalchemy.orm import Session

from service.store.queries.pool import live_claim
from service.store.tables import AcquisitionItemRow, AcquisitionRow, ClaimRow, LabelRow, QueueRow, ScoringRow, ShardRow


def newest_scoring(
    session: Session, project_id: UUID, strategy: str, round_id: UUID | None, status: str | None = None
) -> ScoringRow | None:
    """The youngest scoring of a strategy under a round that has not failed, or that has this status."""
    statement = select(ScoringRow).where(
        ScoringRow.project_id == project_id,
        ScoringRow.strategy == strategy,
        ScoringRow.round_id == round_id if round_id else ScoringRow.round_id.is_(None),
        ScoringRow.status != "failed" if status is None else ScoringRow.status == status,
    )
    return session.scalar(statement.order_by(ScoringRow.created_at.desc()).limit(1))


def free_queue(session: Session, scoring: ScoringRow, count: int, now: datetime) -> Sequence[QueueRow]:
    """The best ranked segments that are neither labeled nor under a live lease; expiry is checked here, by no sweep."""
    label = and_(
        LabelRow.project_id == QueueRow.project_id,
        LabelRow.trajectory_id == QueueRow.trajectory_id,
        LabelRow.start == QueueRow.start,
    )
    claim = and_(
        ClaimRow.project_id == QueueRow.project_id,
        ClaimRow.trajectory_id == QueueRow.trajectory_id,
        ClaimRow.start == QueueRow.start,
        live_claim(now),
    )
    statement = (
        select(QueueRow)
        .outerjoin(LabelRow, label)
        .outerjoin(ClaimRow, claim)
        .where(QueueRow.scoring_id == scoring.id, LabelRow.id.is_(None), ClaimRow.token.is_(None))
    )
    return session.scalars(statement.order_by(QueueRow.rank).limit(count)).all()


def take_claims(session: Session, claims: Sequence[ClaimRow]) -> None:
    """Write claims of one project over the expired ones of the same segments, a few statements for any number."""
    segments = [(claim.trajectory_id, claim.start) for claim in claims]
    for i in range(0, len(segments), 500):  # PostgreSQL bounds the depth of a statement
        named = tuple_(ClaimRow.trajectory_id, ClaimRow.start).in_(segments[i : i + 500])
        stale = delete(ClaimRow).where(ClaimRow.project_id == claims[0].project_id, named)
        session.execute(stale.execution_options(synchronize_session=False))
    session.add_all(claims)


def claim_on(session: Session, project_id: UUID, trajectory: str, start: int) -> ClaimRow | None:
    """Whoever holds, or last held, the segment."""
    return session.get(ClaimRow, (project_id, trajectory, start))


def claims_of(session: Session, acquisition_id: UUID, token: int) -> Sequence[ClaimRow]:
    """What an acquisition still holds."""
    statement = select(ClaimRow).where(ClaimRow.acquisition_id == acquisition_id, ClaimRow.token == token)
    return session.scalars(statement).all()


def extend_claims(session: Session, acquisition_id: UUID, token: int, expires_at: datetime) -> None:
    """Move the end of all claims of an acquisition."""
    where = and_(ClaimRow.acquisition_id == acquisition_id, ClaimRow.token == token)
    session.execute(update(ClaimRow).where(where).values(expires_at=expires_at))


def items_with_labels(session: Session, acquisition_id: UUID) -> Sequence[tuple[AcquisitionItemRow, UUID | None]]:
    """The items of a batch by rank, each with the id of its segment's label in this acquisition's project, if any."""
    label = and_(
        LabelRow.project_id == AcquisitionRow.project_id,
        LabelRow.trajectory_id == AcquisitionItemRow.trajectory_id,
        LabelRow.start == AcquisitionItemRow.start,
    )
    statement = (
        select(AcquisitionItemRow, LabelRow.id)
        .join(AcquisitionRow, AcquisitionRow.id == AcquisitionItemRow.acquisition_id)
        .outerjoin(LabelRow, label)
        .where(AcquisitionItemRow.acquisition_id == acquisition_id)
        .order_by(AcquisitionItemRow.rank)
    )
    return [(item, label_id) for item, label_id in session.execute(statement)]


def drop_from_queues(session: Session, project_id: UUID, trajectory: str, start: int) -> None:
    """A labeled segment is in no queue."""
    session.execute(
        delete(QueueRow).where(
            QueueRow.project_id == project_id, QueueRow.trajectory_id == trajectory, QueueRow.start == start
        )
    )


def replace_queue(session: Session, scoring: ScoringRow, rows: Sequence[QueueRow]) -> None:
    """The queue of a scoring becomes `rows`; queues of the same strategy's older scorings go."""
    older = select(ScoringRow.id).where(
        ScoringRow.project_id == scoring.project_id,
        ScoringRow.strategy == scoring.strategy,
        ScoringRow.created_at < scoring.created_at,
    )
    session.execute(delete(QueueRow).where(or_(QueueRow.scoring_id == scoring.id, QueueRow.scoring_id.in_(older))))
    session.add_all(rows)


def shards(session: Session, scoring_id: UUID) -> Sequence[ShardRow]:
    """The shards of a scoring in order."""
    return session.scalars(select(ShardRow).where(ShardRow.scoring_id == scoring_id).order_by(ShardRow.number)).all()


def unscored_shards(session: Session, scoring_id: UUID) -> int:
    """How many shards have no scores yet."""
    where = and_(ShardRow.scoring_id == scoring_id, ShardRow.blob_sha256.is_(None))
    return session.scalar(select(func.count()).where(where)) or 0
