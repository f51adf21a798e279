"""The checkpoint of a job: a blob that its row refers to, from which another attempt goes on."""

from sqlalchemy.orm import Session

from service.errors import ServiceError
from service.log import get_logger
from service.store.blobs import Blobs
from service.store.errors import CorruptBlob, MissingBlob
from service.store.tables import JobRow
from workers.job import RunningJob

log = get_logger("worker")


class Checkpoint:
    """That of one stage of a job: it takes up none of another name.

    Equal bytes are one blob, and a replaced one is deleted: whoever writes puts the job's id into them.
    """

    def __init__(self, job: RunningJob, stage: str) -> None:
        self._job, self._stage = job, stage

    def load(self) -> bytes | None:
        """What an earlier attempt left; None where there is nothing whole. Raises BlobsUnavailable: what a store that
        is away for now holds is another attempt's."""
        with self._job.worker.database.read() as session:
            row = session.get_one(JobRow, self._job.lease.job_id)
        if row.checkpoint_sha256 is None or row.checkpoint_stage != self._stage:
            return None
        try:
            return self._job.worker.blobs.get("checkpoints", row.checkpoint_sha256)
        except (MissingBlob, CorruptBlob) as error:
            self.cannot_use(error)
            return None

    def cannot_use(self, error: Exception) -> None:
        """Tell why what was loaded is of no use: the stage begins anew."""
        log.warning("checkpoint_unusable", stage=self._stage, error=str(error))

    def write(self, data: bytes) -> str:
        """Store the bytes, before the transaction that refers to them; their sha256."""
        return self._job.worker.blobs.put("checkpoints", data)

    def refer(self, session: Session, sha256: str | None) -> str | None:
        """The job's row refers to these bytes, or to none, from this transaction on; what it referred to before."""
        row = session.get_one(JobRow, self._job.lease.job_id)
        replaced = row.checkpoint_sha256
        row.checkpoint_sha256, row.checkpoint_stage = sha256, None if sha256 is None else self._stage
        return None if replaced == sha256 else replaced

    def discard(self, sha256: str | None) -> None:
        """Delete what no row refers to any more."""
        delete_unneeded(self._job.worker.blobs, "checkpoints", sha256)


def delete_unneeded(store: Blobs, kind: str, sha256: str | None) -> None:
    """Delete a blob that no row refers to any more, if there is one."""
    if sha256 is None:
        return
    try:
        store.delete(kind, sha256)
    except (ServiceError, OSError) as error:  # it only takes up room
        log.warning("blob_not_deleted", kind=kind, sha256=sha256, error=str(error))
