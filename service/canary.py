"""Canaries: jobs that do nothing, one a queue, queued again and again. That they are done shows that work gets done."""

from datetime import datetime, timedelta
from typing import get_args
from uuid import UUID, uuid5

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from api_schemas.jobs import Canary, Queue
from service import jobs
from service.store.queries import jobs as queries
from service.store.tables import JobRow

WORKER_SILENCE = timedelta(seconds=30)  # a worker that said nothing for longer is not counted
NAMESPACE = UUID("6f1d9f0e-5a3c-4a0b-9a51-0c6f3b1f7d42")
QUEUES: tuple[Queue, ...] = tuple(queue for queue in get_args(Queue) if queue != "default")  # it carries no job of ours


def job_id(queue: str) -> UUID:
    """The id of a queue's canary, the same everywhere and always."""
    return uuid5(NAMESPACE, queue)


def plant(session: Session, now: datetime, every: float) -> None:
    """Queue each canary anew that ended, in whatever way, at least `every` seconds ago, and those that are missing."""
    rows = {row.queue: row for row in queries.canaries(session)}
    for queue in QUEUES:
        if queue not in rows:
            _plant_first(session, queue, now)
    for row in queries.ended_canaries(session, now - timedelta(seconds=every)):
        row.state, row.attempts, row.progress, row.error = "queued", 0, 0.0, None
        row.sent_at = row.not_before = row.started_at = None


def ages(session: Session, now: datetime) -> dict[str, float | None]:
    """By queue, seconds since its canary was last done; None where it never was."""
    rows = {row.queue: row for row in queries.canaries(session)}
    return {queue: _age(rows.get(queue), now) for queue in QUEUES}


def healthy(session: Session, now: datetime, within: float) -> dict[str, bool]:
    """By queue, whether its canary or any other job was done lately, or one of its workers is at work.

    A canary may be late where work gets done: it waits its turn behind messages that were sent before it.
    """
    at_work, known, since = queries.queues_at_work(session, now), ages(session, now), now - timedelta(seconds=within)
    return {
        queue: _young(known[queue], within) or queue in at_work or queries.done_since(session, queue, since)
        for queue in QUEUES
    }


def done(now: datetime) -> dict[str, object]:
    """The result of a canary. A later failure leaves it alone, unlike the row's own times."""
    return {"completed": now.isoformat()}


def _plant_first(session: Session, queue: Queue, now: datetime) -> None:
    try:
        with session.begin_nested():
            jobs.enqueue(session, None, Canary(queue=queue), job_id(queue), now, job_id=job_id(queue))
    except IntegrityError:  # another process planted it at this moment
        return


def _age(row: JobRow | None, now: datetime) -> float | None:
    completed = None if row is None else row.result.get("completed")
    if not isinstance(completed, str):
        return None
    return max(0.0, (now - datetime.fromisoformat(completed)).total_seconds())


def _young(age: float | None, within: float) -> bool:
    return age is not None and age <= within
