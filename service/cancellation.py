"""Cancelling a job, with what follows for the round or scoring that it works on."""

from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from service import jobs, rounds, scorings
from service.store.tables import JobRow


def cancel(session: Session, job_id: UUID, now: datetime) -> JobRow:
    """Stop a job for good: a worker that runs it is told by its next heartbeat, and nothing it writes is taken.

    Its round is cancelled, its scoring failed. Cancelled already, it stays so. Raises UnknownResource, JobFinished.
    """
    row = jobs.cancel(session, job_id, now)
    if row.kind == "train_round":
        rounds.cancel(session, row.subject_id, now)
    elif row.kind in ("score_shard", "merge_scores"):
        _cancel_scoring(session, row.subject_id, now)
    return row


def _cancel_scoring(session: Session, scoring_id: UUID, now: datetime) -> None:
    scorings.fail(session, scoring_id, now)
    round_id = scorings.find(session, scoring_id).round_id
    if round_id is not None and rounds.find(session, round_id, lock=True).status == "scoring":
        rounds.cancel(session, round_id, now)
