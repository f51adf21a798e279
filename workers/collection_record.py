"""The record of a collection in its job's row: a checkpoint and the result so far, in the transaction of each batch."""

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy.orm import Session

from api_schemas.jobs import Collect
from api_schemas.trajectories import TrajectoryReceipt
from service import events, jobs
from service.log import get_logger
from service.store.tables import JobRow
from workers.checkpoint import Checkpoint
from workers.job import RunningJob
from workers.quotas import Quota
from workers.standing import Standing

log = get_logger("worker")
KNOWN = "known_before"  # trajectories that the project had: of an earlier collection, or of another shard


class CollectionRecord:
    """Where a job's collection stands: at its beginning, or behind the last batch that an earlier attempt stored."""

    def __init__(self, job: RunningJob, asked: Collect) -> None:
        self._job, self._asked, self._known = job, asked, 0
        self._checkpoint = Checkpoint(job, "collection")
        self.standing = self._resumed() or Standing.of_beginning(asked)

    @contextmanager
    def batch(self, quota: Quota) -> Iterator[tuple[Session, list[TrajectoryReceipt]]]:
        """The transaction that stores a batch, whose receipts are put into the list: progress, so attempts count anew.
        Raises JobLost."""
        receipts = list[TrajectoryReceipt]()
        sha256 = self._checkpoint.write(self.standing.to_bytes(str(self._job.lease.job_id), self._asked))
        with self._job.transaction() as session:
            yield session, receipts
            self._known += sum(receipt.status == "duplicate" for receipt in receipts)
            replaced = self._checkpoint.refer(session, sha256)
            session.get_one(JobRow, self._job.lease.job_id).result = self.result(quota)
            jobs.made_progress(session, self._job.lease)
        self._checkpoint.discard(replaced)

    def close(self) -> None:
        """All is stored: nothing is left to go on from. Raises JobLost."""
        with self._job.transaction() as session:
            left = self._checkpoint.refer(session, None)
        self._checkpoint.discard(left)

    def result(self, quota: Quota) -> dict[str, object]:
        """What was collected so far."""
        drawn = self.standing.drawn
        return {
            "trajectories": drawn.trajectories,
            "transitions": drawn.transitions,
            "labels": dict(quota.taken),
            "short_of": quota.missing(),
            KNOWN: self._known,
        }

    def _resumed(self) -> Standing | None:
        data = self._checkpoint.load()
        if data is None:
            return None
        try:
            standing = Standing.from_bytes(data, str(self._job.lease.job_id), self._asked)
        except ValueError as error:  # an upgrade came between the attempts
            self._checkpoint.cannot_use(error)
            return None
        self._tell_of_resuming(standing)
        return standing

    def _tell_of_resuming(self, standing: Standing) -> None:
        with self._job.transaction() as session:
            row = session.get_one(JobRow, self._job.lease.job_id)
            self._known = int(str(row.result.get(KNOWN, 0)))
            data: dict[str, object] = {"job": str(row.id), "trajectories": standing.drawn.trajectories}
            events.record(session, row.project_id, "collection.resumed", data, self._job.now())
        log.info("collection_resumed", trajectories=standing.drawn.trajectories)
