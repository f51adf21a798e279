"""The job table: the truth about every job, whoever carries it to a worker.

A job is claimed under a lease and a fence. Its holder renews the lease by heartbeats; when the holder falls silent the
lease ends, the job is queued again, and whatever the old holder writes afterwards is refused by its fence.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from uuid import UUID, uuid4

from pydantic import TypeAdapter
from sqlalchemy.orm import Session

from api_schemas.jobs import PRIORITIES, QUEUES, Canary, Job, JobPayload
from service import events, origin
from service.clock import Clock
from service.errors import ServiceError, UnknownResource
from service.store.queries import jobs as queries
from service.store.tables import JobRow, WorkerRow

PAYLOADS: TypeAdapter[JobPayload] = TypeAdapter(JobPayload)
RETRY_SECONDS = (1.0, 5.0, 20.0, 60.0)  # before the second, third, ... attempt of a job that failed


class JobFinished(ServiceError):
    """A job that has ended cannot be cancelled."""

    status_code = 409

    def __init__(self, job: UUID, state: str, successor: UUID | None = None) -> None:
        left = f"its round goes on in job {successor}" if successor else "there is nothing left to cancel"
        super().__init__(f"job {job} is {state}; {left}")


class JobLost(ServiceError):
    """Another worker holds this job by now; what this one did is not stored."""

    status_code = 409

    def __init__(self, job: UUID, fence: int) -> None:
        super().__init__(f"job {job}: fence {fence} is not the current one")


@dataclass(frozen=True)
class Lease:
    """What a worker holds while it runs a job."""

    job_id: UUID
    fence: int
    queue: str
    priority: int


def enqueue(
    session: Session,
    project_id: UUID | None,
    payload: JobPayload,
    subject_id: UUID,
    now: datetime,
    max_attempts: int = 3,
    job_id: UUID | None = None,
) -> JobRow:
    """A queued job, in the caller's transaction: it exists if and only if the caller's other writes do."""
    row = JobRow(
        id=job_id or uuid4(),
        project_id=project_id,
        kind=payload.kind,
        queue=payload.queue if isinstance(payload, Canary) else QUEUES[payload.kind],
        priority=PRIORITIES.get(payload.kind, 0),
        payload=payload.model_dump(mode="json"),
        subject_id=subject_id,
        state="queued",
        max_attempts=max_attempts,
        correlation=origin.current().correlation,
        result={},
        created_at=now,
    )
    session.add(row)
    session.flush()
    _tell(session, row, "queued", now)
    return row


def payload_of(row: JobRow) -> JobPayload:
    """The typed payload."""
    return PAYLOADS.validate_python(row.payload)


def claim_next(session: Session, queues: Sequence[str], owner: str, now: datetime, lease: float) -> JobRow | None:
    """Claim the next waiting job of these queues, for `lease` seconds."""
    row = queries.next_job(session, queues, now)
    return None if row is None else _claim(session, row, owner, now, lease)


def claim(session: Session, job_id: UUID, owner: str, now: datetime, lease: float) -> JobRow | None:
    """Claim this job; None where it has ended, is held by another or unknown, so a message may arrive twice.

    One that a silent worker held is claimed too, unless that was its last attempt: it is the reaper's to fail.
    """
    row = queries.locked_job(session, job_id)
    if row is None or row.state not in ("queued", "running"):
        return None
    held_now = row.lease_until is not None and row.lease_until > now
    if row.state == "running" and (held_now or row.attempts >= row.max_attempts):
        return None
    return _claim(session, row, owner, now, lease)


def lease_of(row: JobRow) -> Lease:
    """The lease that a claim has just made."""
    return Lease(row.id, row.fence, row.queue, row.priority)


def held(session: Session, lease: Lease) -> JobRow:
    """The job's row, if this lease is still its newest. Raises JobLost; call it in every transaction of a job."""
    row = queries.locked_job(session, lease.job_id)
    if row is None or row.fence != lease.fence or row.state != "running":
        raise JobLost(lease.job_id, lease.fence)
    return row


def heartbeat(session: Session, lease: Lease, clock: Clock, seconds: float, progress: float, message: str) -> None:
    """Renew the lease and say how far the job is. Raises JobLost.

    The clock is read once the row is locked: the job's own transaction may hold it for a while.
    """
    row, now = held(session, lease), clock()
    row.lease_until = now + timedelta(seconds=seconds)
    row.heartbeat_at = now
    row.progress = progress
    row.message = message


def made_progress(session: Session, lease: Lease) -> None:
    """A stage is stored for good: what goes wrong from here on is counted anew. Raises JobLost."""
    held(session, lease).attempts = 1


def complete(session: Session, lease: Lease, result: dict[str, object], now: datetime) -> JobRow:
    """The job is done. Raises JobLost."""
    row = held(session, lease)
    row.state, row.progress, row.result, row.finished_at = "done", 1.0, result, now
    row.owner = row.lease_until = None
    _tell(session, row, "done", now)
    return row


def fail(session: Session, lease: Lease, error: str, now: datetime, *, retry: bool) -> JobRow:
    """The attempt failed: queued again after a pause while attempts are left and `retry` holds, else failed."""
    row = held(session, lease)
    _end_attempt(session, row, error, now, retry=retry)
    return row


def give_back(session: Session, lease: Lease, now: datetime) -> None:
    """Queue the job again without counting the attempt: its worker stops, or higher priority work waits."""
    row = held(session, lease)
    row.state, row.owner, row.lease_until, row.sent_at = "queued", None, None, None
    row.attempts -= 1
    row.heartbeat_at = now
    _tell(session, row, "gave_way", now)


def cancel(session: Session, job_id: UUID, now: datetime) -> JobRow:
    """Nobody is to run the job any more; whoever holds it has lost it. Raises UnknownResource, JobFinished."""
    row = queries.locked_job(session, job_id)
    if row is None:
        raise UnknownResource("job", job_id)
    if row.state in ("done", "failed"):
        raise JobFinished(job_id, row.state)
    if row.state != "cancelled":
        row.state, row.owner, row.lease_until, row.finished_at = "cancelled", None, None, now
        row.fence += 1
        _tell(session, row, "cancelled", now)
    return row


def reap_one(session: Session, now: datetime) -> JobRow | None:
    """Queue the job of a silent worker again, or fail it where its attempts are used up; None where there is none."""
    row = queries.silent(session, now)
    if row is not None:
        error = f"worker {row.owner} fell silent in attempt {row.attempts} of {row.max_attempts}"
        _end_attempt(session, row, error, now, retry=True)
    return row


def worker_alive(session: Session, owner: str, queues: Sequence[str], now: datetime) -> None:
    """A worker says that it is there."""
    session.merge(WorkerRow(owner=owner, queues=list(queues), heartbeat_at=now))


def find(session: Session, job_id: UUID) -> JobRow:
    """The job's row. Raises UnknownResource."""
    row = session.get(JobRow, job_id)
    if row is None:
        raise UnknownResource("job", job_id)
    return row


def describe(row: JobRow) -> Job:
    """The job as the API shows it."""
    fields = {name: getattr(row, name) for name in Job.model_fields if name not in ("project",)}
    return Job(project=row.project_id, **fields)


def _claim(session: Session, row: JobRow, owner: str, now: datetime, lease: float) -> JobRow:
    row.state, row.owner = "running", owner
    row.fence += 1
    row.attempts += 1
    row.heartbeat_at, row.lease_until = now, now + timedelta(seconds=lease)
    row.started_at = row.started_at or now
    _tell(session, row, "started", now, attempt=row.attempts)
    return row


def _end_attempt(session: Session, row: JobRow, error: str, now: datetime, *, retry: bool) -> None:
    row.owner = row.lease_until = row.sent_at = None
    row.error = error
    again = retry and row.attempts < row.max_attempts
    row.state = "queued" if again else "failed"
    if again:
        pause = RETRY_SECONDS[min(row.attempts, len(RETRY_SECONDS)) - 1]
        row.not_before = now + timedelta(seconds=pause)
    else:
        row.finished_at = now
    _tell(session, row, "retried" if again else "failed", now, error=error)


def _tell(session: Session, row: JobRow, what: str, now: datetime, **more: object) -> None:
    """Record the change. Where no request is at hand it goes back to the one that asked for the job."""
    if row.project_id is None:
        return
    data = {"job": str(row.id), "kind": row.kind, **more}
    with origin.bound(correlation=origin.current().correlation or row.correlation):
        events.record(session, row.project_id, f"job.{what}", data, now)
