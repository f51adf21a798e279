"""Cancelling a job, with what follows for the round, scoring or policy that it works on."""

from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from api_schemas.jobs import TrainRound
from service import jobs, policies, rounds, scorings
from service.jobs import JobFinished
from service.store.queries import acquisitions as acquisition_queries
from service.store.queries import jobs as job_queries
from service.store.tables import JobRow


def cancel(session: Session, job_id: UUID, now: datetime) -> JobRow:
    """Stop a job for good: a worker that runs it is told by its next heartbeat, and nothing it writes is taken.

    Its round is cancelled, its scoring failed, the state of its policy released. Cancelled already, it stays so. Raises
    UnknownResource, JobFinished.
    """
    _check_successor(session, jobs.find(session, job_id))
    row = jobs.cancel(session, job_id, now)
    if row.kind == "train_round":
        rounds.cancel(session, row.subject_id, now)
    elif row.kind == "propose_explorations":
        scorings.fail(session, row.subject_id, now)
    elif row.kind == "train_policy":
        policies.release_state(session, row.subject_id, row.id)
    elif row.kind in ("score_shard", "merge_scores"):
        _cancel_scoring(session, row.subject_id, now)
    return row


def _check_successor(session: Session, row: JobRow) -> None:
    """Who cancels a round by its training, which is done, is told which job to cancel. Raises JobFinished."""
    payload = jobs.payload_of(row)
    if row.state == "done" and row.project_id is not None and isinstance(payload, TrainRound):
        scoring = acquisition_queries.newest_scoring(session, row.project_id, payload.strategy, payload.round)
        scored_now = scoring is not None and scoring.status == "scoring"
        at_work = job_queries.unfinished(session, scoring.id) if scoring and scored_now else None
        if at_work is not None:
            raise JobFinished(row.id, row.state, at_work.id)


def _cancel_scoring(session: Session, scoring_id: UUID, now: datetime) -> None:
    scorings.fail(session, scoring_id, now)
    round_id = scorings.find(session, scoring_id).round_id
    if round_id is not None:  # one that is in use has another scoring cancelled, and stays in use
        rounds.cancel(session, round_id, now, while_in=("scoring",))
