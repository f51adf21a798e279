"""The job table as a queue."""

from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

from sqlalchemy import ColumnElement, delete, false, func, or_, select, update
from sqlalchemy.orm import Session

from service.store.tables import JobRow, WorkerRow


def next_job(session: Session, queues: Sequence[str], now: datetime) -> JobRow | None:
    """The job to claim next: highest priority, then oldest. Rows that another claims at this moment are passed over."""
    statement = select(JobRow).where(_waiting(queues, now))
    statement = statement.order_by(JobRow.priority.desc(), JobRow.created_at, JobRow.id).limit(1)
    return session.scalar(statement.with_for_update(skip_locked=True))


def locked_job(session: Session, job_id: UUID) -> JobRow | None:
    """The job's row, locked where the database locks rows, and then read anew."""
    statement = select(JobRow).where(JobRow.id == job_id).with_for_update()
    return session.scalar(statement.execution_options(populate_existing=True))


def higher_waiting(session: Session, queues: Sequence[str], priority: int, now: datetime) -> bool:
    """True where a job of higher priority waits in one of the queues; a canary is not worth an interruption."""
    statement = select(JobRow.id).where(_waiting(queues, now), JobRow.priority > priority, JobRow.kind != "canary")
    return session.scalar(statement.limit(1)) is not None


def unfinished(session: Session, subject_id: UUID, kind: str | None = None) -> JobRow | None:
    """A queued or running job, of this kind or of any, that works on the subject."""
    statement = select(JobRow).where(JobRow.subject_id == subject_id, JobRow.state.in_(("queued", "running")))
    if kind is not None:
        statement = statement.where(JobRow.kind == kind)
    return session.scalar(statement.order_by(JobRow.created_at).limit(1))


def newest(session: Session, subject_id: UUID) -> JobRow | None:
    """The youngest job on the subject."""
    statement = select(JobRow).where(JobRow.subject_id == subject_id)
    return session.scalar(statement.order_by(JobRow.created_at.desc()).limit(1))


def silent(session: Session, now: datetime) -> JobRow | None:
    """A running job whose lease has ended, if there is one that nobody else has in hand."""
    statement = select(JobRow).where(JobRow.state == "running", JobRow.lease_until <= now)
    return session.scalar(statement.order_by(JobRow.lease_until).limit(1).with_for_update(skip_locked=True))


def unsent(session: Session, now: datetime, limit: int) -> Sequence[JobRow]:
    """Jobs that may run now and that no carrier was given, those of highest priority first."""
    statement = select(JobRow).where(JobRow.state == "queued", _ready(now), JobRow.sent_at.is_(None))
    return session.scalars(statement.order_by(JobRow.priority.desc(), JobRow.created_at).limit(limit)).all()


def unclaimed(session: Session, queue: str, now: datetime, sent_before: datetime, limit: int) -> Sequence[JobRow]:
    """Jobs of a queue that may run, were given to a carrier before then, and wait still; those sent first go first."""
    statement = select(JobRow).where(_waiting([queue], now), JobRow.sent_at <= sent_before)
    return session.scalars(statement.order_by(JobRow.sent_at, JobRow.id).limit(limit)).all()


def neglected_queues(session: Session, queues: Sequence[str], sent_before: datetime, now: datetime) -> list[str]:
    """Those of the queues in which a job waits that was given to a carrier before then."""
    statement = select(JobRow.queue).where(_waiting(queues, now), JobRow.sent_at <= sent_before)
    return list(session.scalars(statement.distinct()))


def mark_sent(session: Session, job_id: UUID, now: datetime) -> None:
    """Note that a carrier has the job, unless it was claimed in the meantime."""
    session.execute(update(JobRow).where(JobRow.id == job_id, JobRow.state == "queued").values(sent_at=now))


def counts_by_state(session: Session) -> Sequence[tuple[str, str, int]]:
    """(queue, state, number of jobs); canaries apart."""
    statement = select(JobRow.queue, JobRow.state, func.count()).where(JobRow.kind != "canary")
    statement = statement.group_by(JobRow.queue, JobRow.state)
    return [(queue, state, count) for queue, state, count in session.execute(statement)]


def canaries(session: Session) -> Sequence[JobRow]:
    """The canaries of all queues."""
    return session.scalars(select(JobRow).where(JobRow.kind == "canary", JobRow.project_id.is_(None))).all()


def ended_canaries(session: Session, before: datetime) -> Sequence[JobRow]:
    """Canaries that ended before then, locked; those that another process has in hand are passed over."""
    ended = JobRow.state.in_(("done", "failed", "cancelled"))
    statement = select(JobRow).where(
        JobRow.kind == "canary", JobRow.project_id.is_(None), ended, JobRow.finished_at <= before
    )
    return session.scalars(statement.with_for_update(skip_locked=True)).all()


def queues_at_work(session: Session, now: datetime) -> set[str]:
    """Queues served by a worker that holds a job under a live lease."""
    statement = select(WorkerRow.queues).join(JobRow, JobRow.owner == WorkerRow.owner)
    statement = statement.where(JobRow.state == "running", JobRow.lease_until > now, JobRow.kind != "canary")
    return {str(queue) for queues in session.scalars(statement) for queue in queues}


def done_since(session: Session, queue: str, since: datetime) -> bool:
    """True where a job of the queue was done then or later."""
    statement = select(JobRow.id).where(JobRow.state == "done", JobRow.queue == queue, JobRow.finished_at >= since)
    return session.scalar(statement.limit(1)) is not None


def held_by_process(session: Session, host: str, pids: Sequence[int], now: datetime) -> bool:
    """True where one of these processes holds a job under a live lease."""
    mine = or_(*(JobRow.owner.startswith(f"{host}:{pid}:", autoescape=True) for pid in pids)) if pids else false()
    statement = select(JobRow.id).where(JobRow.state == "running", JobRow.lease_until > now, mine)
    return session.scalar(statement.limit(1)) is not None


def live_workers(session: Session, since: datetime) -> int:
    """Workers heard of since then. A scheduler says too that it is there; it serves no queue."""
    serving = func.json_array_length(WorkerRow.queues) > 0
    return session.scalar(select(func.count()).where(WorkerRow.heartbeat_at >= since, serving)) or 0


def heard_from_host(session: Session, host: str, since: datetime) -> bool:
    """True where a worker or scheduler of that machine was heard of since then."""
    mine = WorkerRow.owner.startswith(f"{host}:", autoescape=True)
    return session.scalar(select(WorkerRow.owner).where(mine, WorkerRow.heartbeat_at >= since).limit(1)) is not None


def forget_workers(session: Session, before: datetime) -> None:
    """Drop the workers that were last heard of before then."""
    session.execute(delete(WorkerRow).where(WorkerRow.heartbeat_at < before))


def _waiting(queues: Sequence[str], now: datetime) -> ColumnElement[bool]:
    return (JobRow.state == "queued") & JobRow.queue.in_(queues) & _ready(now)


def _ready(now: datetime) -> ColumnElement[bool]:
    """The pause before another attempt is over."""
    return or_(JobRow.not_before.is_(None), JobRow.not_before <= now)
