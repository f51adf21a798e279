"""From a claimed job to the run_* function of its kind. Both carriers come here."""

import os
import socket
from collections.abc import Callable
from datetime import datetime
from uuid import UUID, uuid4

import structlog
from sqlalchemy.exc import SQLAlchemyError

from api_schemas.jobs import (
    Canary,
    Collect,
    JobPayload,
    MergeScores,
    ProposeExplorations,
    ScoreShard,
    SelectQueue,
    TrainPolicy,
    TrainRound,
    TrainSubgoalGenerator,
)
from service import canary, jobs, origin, reaper, traces
from service.jobs import JobLost
from service.log import get_logger
from service.settings import Settings
from service.store.blobs import Blobs
from service.store.database import open_database
from service.store.errors import BlobsUnavailable
from service.store.tables import JobRow
from workers.job import GaveWay, Heartbeat, RunningJob, Worker
from workers.watchdog import Watchdog

log = get_logger("worker")
TRANSIENT = (
    OSError,
    SQLAlchemyError,
    MemoryError,
    BlobsUnavailable,
)  # another attempt may succeed; anything else would fail again
Result = dict[str, object]


def open_worker(
    settings: Settings, clock: Callable[[], datetime], queues: tuple[str, ...], *, expendable: bool = False
) -> Worker:
    """A worker of this process on the settings' stores. expendable: the process does nothing else, and ends where its
    job hangs."""
    owner = f"{socket.gethostname()}:{os.getpid()}:{uuid4().hex[:8]}"
    database = open_database(settings.resolved_database_url())
    blobs, watchdog = Blobs(settings.resolved_blobs_url()), Watchdog(armed=expendable)
    return Worker(settings, database, blobs, clock, owner, queues, watchdog=watchdog)


def run_next(worker: Worker) -> bool:
    """Claim and run the next job of the worker's queues; False where none waits."""
    with origin.bound(actor=worker.owner), worker.database.write() as session:
        lease = worker.settings.job_lease_seconds
        row = jobs.claim_next(session, worker.queues, worker.owner, worker.clock(), lease)
    if row is not None:
        run_claimed(worker, row)
    return row is not None


def run_job(worker: Worker, job_id: UUID) -> bool:
    """Claim and run this job; False where it is done or held by another, as when a message arrives twice."""
    with origin.bound(actor=worker.owner), worker.database.write() as session:
        row = jobs.claim(session, job_id, worker.owner, worker.clock(), worker.settings.job_lease_seconds)
    if row is not None:
        run_claimed(worker, row)
    return row is not None


def run_claimed(worker: Worker, row: JobRow) -> None:
    """Run a job that this worker has claimed, to one of its ends."""
    job = RunningJob(worker, jobs.lease_of(row))
    told: dict[str, str | int] = {
        "asim.job": str(row.id),
        "asim.attempt": row.attempts,
        traces.CORRELATION: row.correlation,
    }
    with (
        origin.bound(worker.owner, row.correlation),
        traces.span(worker.settings.traces_url, f"job {row.kind}", told),
        structlog.contextvars.bound_contextvars(job=str(row.id), kind=row.kind, attempt=row.attempts),
    ):
        tell = log.debug if row.kind == "canary" else log.info  # of canaries the failures are enough
        tell("job_started")
        try:
            with Heartbeat(job):
                result = _run(job, jobs.payload_of(row))
            with worker.database.write() as session:
                jobs.complete(session, job.lease, result, job.now())
            tell("job_done", result=result)
        except JobLost as lost:
            log.warning("job_lost", error=str(lost))
        except GaveWay as reason:
            _give_back(job, reason)
        except Exception as error:  # the boundary: whatever a job raises becomes the job's error
            _fail(job, error)


def _run(job: RunningJob, payload: JobPayload) -> Result:
    """The imports stay here: a collector loads no torch, a trainer no simulator."""
    match payload:
        case Collect():
            from service.store.provenance import open_provenance
            from workers.collection import run_collection

            return run_collection(job, payload, open_provenance(job.worker.settings))
        case TrainPolicy():
            from service.store.provenance import open_provenance
            from workers.policy_training import run_policy_training

            return run_policy_training(job, payload.policy, open_provenance(job.worker.settings))
        case TrainRound():
            from workers.training import run_round

            return run_round(job, payload)
        case TrainSubgoalGenerator():
            from workers.training import run_subgoal_generator

            return run_subgoal_generator(job, payload)
        case Canary():
            return canary.done(job.now())
        case _:
            return _score(job, payload)


def _score(job: RunningJob, payload: ScoreShard | MergeScores | SelectQueue | ProposeExplorations) -> Result:
    if isinstance(payload, ProposeExplorations):
        from workers.exploration import run_proposals

        return run_proposals(job, payload.scoring, payload.length)
    from workers.scoring import run_selection, run_shard

    if isinstance(payload, ScoreShard):
        return run_shard(job, payload)
    length = payload.length if isinstance(payload, SelectQueue) else job.worker.settings.queue_length
    return run_selection(job, payload.scoring, length)


def _give_back(job: RunningJob, reason: GaveWay) -> None:
    try:
        with job.worker.database.write() as session:
            jobs.give_back(session, job.lease, job.now())
        log.info("job_gave_way", reason=str(reason))
    except JobLost as lost:
        log.warning("job_lost", error=str(lost))


def _fail(job: RunningJob, error: Exception) -> None:
    log.error("job_failed", exc_info=error)
    traces.failed(error)
    sentence = f"{type(error).__name__}: {error}"
    try:
        with job.worker.database.write() as session:
            row = jobs.fail(session, job.lease, sentence, job.now(), retry=isinstance(error, TRANSIENT))
            if row.state == "failed":
                reaper.give_up(session, row, job.now())
    except JobLost as lost:
        log.warning("job_lost", error=str(lost))
