"""Counts and ages over all projects, for metrics."""

from collections.abc import Sequence
from datetime import datetime
from typing import NamedTuple
from uuid import UUID

from sqlalchemy import and_, func, or_, select
from sqlalchemy.orm import Session

from service.store.queries.acquisitions import FREE
from service.store.tables import AcquisitionRow, JobRow, QueueRow, RoundRow, ScoringRow

RECENT_SHARDS = 20


class Oldest(NamedTuple):
    """How many there are, and since when the oldest."""

    number: int
    since: datetime


def waiting_jobs(session: Session, now: datetime) -> dict[str, Oldest]:
    """By queue, jobs that may run and wait for a worker; canaries apart."""
    ready = or_(JobRow.not_before.is_(None), JobRow.not_before <= now)
    statement = select(JobRow.queue, func.count(), func.min(JobRow.created_at))
    statement = statement.where(JobRow.state == "queued", JobRow.kind != "canary", ready).group_by(JobRow.queue)
    return {queue: Oldest(count, since) for queue, count, since in session.execute(statement)}


def open_leases(session: Session, now: datetime) -> dict[UUID, Oldest]:
    """By project, batches under a live lease."""
    statement = select(AcquisitionRow.project_id, func.count(), func.min(AcquisitionRow.created_at))
    live = and_(AcquisitionRow.status == "leased", AcquisitionRow.lease_expires_at > now)
    statement = statement.where(live).group_by(AcquisitionRow.project_id)
    return {project: Oldest(count, since) for project, count, since in session.execute(statement)}


def rounds_by_status(session: Session) -> Sequence[tuple[UUID, str, int]]:
    """(project, status, number of rounds)."""
    statement = select(RoundRow.project_id, RoundRow.status, func.count())
    statement = statement.group_by(RoundRow.project_id, RoundRow.status)
    return [(project, status, count) for project, status, count in session.execute(statement)]


def scoring_rate(session: Session, project_id: UUID) -> float | None:
    """Segments a second of working time, over the youngest shards that were scored; None where none was."""
    statement = select(JobRow.result, JobRow.started_at, JobRow.finished_at)
    statement = statement.where(JobRow.project_id == project_id, JobRow.kind == "score_shard", JobRow.state == "done")
    done = session.execute(statement.order_by(JobRow.finished_at.desc()).limit(RECENT_SHARDS)).all()
    seconds = sum((end - start).total_seconds() for _, start, end in done if start is not None and end is not None)
    scored = sum(int(str(result.get("scored", 0))) for result, _, _ in done)
    return scored / seconds if seconds > 0 else None


def ranked(session: Session, scoring: ScoringRow, now: datetime) -> int:
    """Segments of a queue that POST /acquire could give out now."""
    statement = select(func.count()).select_from(QueueRow).where(FREE)
    return session.scalar(statement, {"scoring": scoring.id, "now": now}) or 0
