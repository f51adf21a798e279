"""What time alone brings about: workers fall silent, leases and kept answers expire; and what follows from it."""

from datetime import datetime, timedelta

from sqlalchemy.orm import Session

from service import jobs, leases, origin, policies, rounds, scorings
from service.store.database import Database
from service.store.queries import idempotency as idempotency_queries
from service.store.queries import jobs as job_queries
from service.store.tables import JobRow

WORKER_MEMORY = timedelta(hours=1)


def reap(database: Database, now: datetime) -> None:
    """Queue the jobs of silent workers again; what has used up its attempts fails with all that waits for it.

    A transaction each: whoever holds one job or project and waits for the next may be waited for.
    """
    with origin.bound(actor="reaper"):
        while _reap_one(database, now):
            pass
        with database.write() as session:
            leases.note_expired(session, now)
        with database.write() as session:
            job_queries.forget_workers(session, now - WORKER_MEMORY)
            idempotency_queries.forget_expired(session, now)


def give_up(session: Session, row: JobRow, now: datetime) -> None:
    """A round or scoring whose job has failed for good has failed too; from a policy's state nobody goes on."""
    error = f"job {row.id} ({row.kind}): {row.error}"
    if row.kind == "train_round":
        rounds.fail(session, row.subject_id, error, now)
    elif row.kind == "propose_explorations":
        scorings.fail(session, row.subject_id, now)
    elif row.kind == "train_policy":
        policies.release_state(session, row.subject_id, row.id)
    elif row.kind in ("score_shard", "merge_scores"):
        scorings.fail(session, row.subject_id, now)
        round_id = scorings.find(session, row.subject_id).round_id
        if round_id is not None:
            rounds.fail(session, round_id, error, now)


def _reap_one(database: Database, now: datetime) -> bool:
    with database.write() as session:
        row = jobs.reap_one(session, now)
        if row is not None and row.state == "failed":
            with origin.bound(correlation=row.correlation):
                give_up(session, row, now)
    return row is not None
