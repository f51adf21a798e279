"""Work that is to be done, and who does it."""

from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from service.store.columns import Row


class JobRow(Row):
    """The truth about a job. `fence` grows with every claim; writes of an older holder are refused."""

    __tablename__ = "job"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    project_id: Mapped[UUID | None] = mapped_column(ForeignKey("project.id"), index=True)  # None for a canary
    kind: Mapped[str] = mapped_column(String(40))
    queue: Mapped[str] = mapped_column(String(10))
    priority: Mapped[int] = mapped_column(default=0)
    payload: Mapped[dict[str, object]]
    subject_id: Mapped[UUID] = mapped_column(index=True)  # the round, scoring, project or collection it works on
    state: Mapped[str] = mapped_column(String(10))
    owner: Mapped[str | None] = mapped_column(String(120))
    fence: Mapped[int] = mapped_column(default=0)
    attempts: Mapped[int] = mapped_column(default=0)
    max_attempts: Mapped[int]
    lease_until: Mapped[datetime | None]
    heartbeat_at: Mapped[datetime | None]
    not_before: Mapped[datetime | None]
    sent_at: Mapped[datetime | None]  # when a carrier was given the id; None is the outbox
    checkpoint_sha256: Mapped[str | None] = mapped_column(String(64))
    checkpoint_stage: Mapped[str | None] = mapped_column(String(60))  # what the checkpoint is one of
    correlation: Mapped[str] = mapped_column(String(100), default="")  # of the request that asked for the job
    progress: Mapped[float] = mapped_column(default=0.0)
    message: Mapped[str] = mapped_column(default="")
    result: Mapped[dict[str, object]]
    error: Mapped[str | None]
    created_at: Mapped[datetime]
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    __table_args__ = (
        Index("ix_job_claim", "state", "queue", "priority", "created_at"),
        Index("ix_job_finished", "queue", "finished_at"),
    )


class WorkerRow(Row):
    """A worker process: which queues it serves and when it was last heard."""

    __tablename__ = "worker"
    owner: Mapped[str] = mapped_column(String(120), primary_key=True)
    queues: Mapped[list[object]]
    heartbeat_at: Mapped[datetime]
