"""The rows. Arrays of scores, weights and observations are blobs; these tables grow with labels and trajectories."""

from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import (
    BigInteger,
    ForeignKey,
    Index,
    String,
    text,
)
from sqlalchemy.orm import Mapped, mapped_column

from service.store.columns import Row
from service.store.horizon import CurrentTransaction


class ProjectRow(Row):
    """One project and its counters, which change under this row's lock only.

    `label_watermark` counts accepted labels, `token` the leases given out; the others count the members of the splits.
    """

    __tablename__ = "project"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    name: Mapped[str] = mapped_column(String(80), unique=True)
    environment: Mapped[dict[str, object]]
    spaces: Mapped[dict[str, object]]
    family: Mapped[str | None] = mapped_column(String(40))
    segment_length: Mapped[int]
    stride: Mapped[int]
    held_out_fraction: Mapped[float]
    seed: Mapped[int]
    policy: Mapped[dict[str, object]]
    label_watermark: Mapped[int] = mapped_column(default=0)
    labels_at_round: Mapped[int] = mapped_column(default=0)  # pool_labels when the last round was requested
    pool_labels: Mapped[int] = mapped_column(default=0)
    held_out_labels: Mapped[int] = mapped_column(default=0)
    pool_trajectories: Mapped[int] = mapped_column(default=0)
    pool_segments: Mapped[int] = mapped_column(default=0)
    held_out_trajectories: Mapped[int] = mapped_column(default=0)
    held_out_segments: Mapped[int] = mapped_column(default=0)
    token: Mapped[int] = mapped_column(default=0)
    created_at: Mapped[datetime]


class TrajectoryRow(Row):
    """Content, shared by all projects that hold it. `id` names the decoded arrays, `blob_sha256` the stored bytes."""

    __tablename__ = "trajectory"
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    blob_sha256: Mapped[str] = mapped_column(String(64))
    transitions: Mapped[int]
    streams: Mapped[dict[str, object]]
    bytes: Mapped[int]
    created_at: Mapped[datetime]


class MembershipRow(Row):
    """A trajectory in a project. `segments` is how many windows the project cuts from it."""

    __tablename__ = "membership"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"))
    trajectory_id: Mapped[str] = mapped_column(ForeignKey("trajectory.id"))
    split: Mapped[str] = mapped_column(String(10))
    segments: Mapped[int]
    provenance_sha256: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[datetime]
    __table_args__ = (
        Index("uq_membership_trajectory", "project_id", "trajectory_id", unique=True),
        Index("ix_membership_split", "project_id", "split", "id"),
    )


class LabelRow(Row):
    """Actions of a segment. The natural key (project, trajectory, start) holds one label for ever."""

    __tablename__ = "label"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"))
    trajectory_id: Mapped[str] = mapped_column(ForeignKey("trajectory.id"))
    start: Mapped[int]
    split: Mapped[str] = mapped_column(String(10))
    actions: Mapped[list[object]]
    action_sets: Mapped[list[object] | None]
    content_sha256: Mapped[str] = mapped_column(String(64))
    residual: Mapped[float | None]
    source: Mapped[dict[str, object]]
    acquisition_id: Mapped[UUID | None]
    watermark: Mapped[int]
    created_at: Mapped[datetime]
    __table_args__ = (
        Index("uq_label_segment", "project_id", "trajectory_id", "start", unique=True),
        Index("ix_label_watermark", "project_id", "watermark"),
    )


class AcquisitionRow(Row):
    """One batch given out. Its lease lives in the claims; `token` is larger than that of any earlier lease."""

    __tablename__ = "acquisition"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"), index=True)
    mode: Mapped[str] = mapped_column(String(10), default="pool")
    purpose: Mapped[str] = mapped_column(String(10))
    strategy: Mapped[str] = mapped_column(String(40))
    requested_strategy: Mapped[str] = mapped_column(String(40))
    round_id: Mapped[UUID | None]
    status: Mapped[str] = mapped_column(String(10))
    reason: Mapped[str | None]  # why the batch is smaller than was asked for
    labeler: Mapped[str] = mapped_column(String(200))
    token: Mapped[int]
    lease_expires_at: Mapped[datetime]
    created_at: Mapped[datetime]
    __table_args__ = (Index("ix_acquisition_expiry", "status", "lease_expires_at"),)


class AcquisitionItemRow(Row):
    """A segment of a batch, for ever; who may label it now is the claim's business.

    An explore item names the observation to start from and the `actions` to execute there; `answer` is the trajectory
    that came of it.
    """

    __tablename__ = "acquisition_item"
    acquisition_id: Mapped[UUID] = mapped_column(ForeignKey("acquisition.id"), primary_key=True)
    rank: Mapped[int] = mapped_column(primary_key=True)
    trajectory_id: Mapped[str] = mapped_column(String(64))
    start: Mapped[int]
    score: Mapped[float | None]
    confidence: Mapped[float | None]
    actions: Mapped[list[object] | None]
    answer: Mapped[str | None] = mapped_column(String(64))


class ClaimRow(Row):
    """Who may label a segment: at most one row a segment, taken over when its lease has expired.

    An explore item claims no segment: its row stands under the acquisition's id and the item's rank.
    """

    __tablename__ = "claim"
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"), primary_key=True)
    trajectory_id: Mapped[str] = mapped_column(String(64), primary_key=True)
    start: Mapped[int] = mapped_column(primary_key=True)
    acquisition_id: Mapped[UUID]
    purpose: Mapped[str] = mapped_column(String(10))
    token: Mapped[int]
    expires_at: Mapped[datetime]
    __table_args__ = (Index("ix_claim_expiry", "project_id", "expires_at"), Index("ix_claim_owner", "acquisition_id"))


class ScoringRow(Row):
    """Scores of one strategy under one round's models (none for a model-free strategy). Scores are blobs, by shard.

    In mode `explore` it stands for what the strategy proposes to execute: no shards, its queue is all there is of it.
    """

    __tablename__ = "scoring"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"))
    round_id: Mapped[UUID | None] = mapped_column(ForeignKey("round.id"))
    mode: Mapped[str] = mapped_column(String(10), default="pool")
    strategy: Mapped[str] = mapped_column(String(40))
    status: Mapped[str] = mapped_column(String(10))  # scoring, ready, failed
    memberships: Mapped[int]  # the pool as it was: memberships up to this id
    shards: Mapped[int]
    selections: Mapped[int] = mapped_column(default=0)
    created_at: Mapped[datetime]
    __table_args__ = (Index("ix_scoring_lookup", "project_id", "strategy", "created_at"),)


class ShardRow(Row):
    """One shard: memberships from `first` to `last` by id. `blob_sha256` is set once it is scored."""

    __tablename__ = "shard"
    scoring_id: Mapped[UUID] = mapped_column(ForeignKey("scoring.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    first: Mapped[int]
    last: Mapped[int]
    blob_sha256: Mapped[str | None] = mapped_column(String(64))


class QueueRow(Row):
    """A ranked segment that POST /acquire may give out.

    `leased_until` spares it a look at the claims for as long; whether the segment is free is the claims' business.
    One with `actions` is an exploration: these are to be executed from the observation at `start`. It goes when it is
    given out.
    """

    __tablename__ = "queue"
    scoring_id: Mapped[UUID] = mapped_column(ForeignKey("scoring.id"), primary_key=True)
    rank: Mapped[int] = mapped_column(primary_key=True)
    project_id: Mapped[UUID]
    trajectory_id: Mapped[str] = mapped_column(String(64))
    start: Mapped[int]
    score: Mapped[float | None]
    confidence: Mapped[float | None]
    leased_until: Mapped[datetime | None]
    actions: Mapped[list[object] | None]
    __table_args__ = (Index("ix_queue_segment", "project_id", "trajectory_id", "start"),)


class RoundRow(Row):
    """One retraining on all labels up to `watermark`. Stages and what they find are written as they are done."""

    __tablename__ = "round"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"))
    number: Mapped[int]
    watermark: Mapped[int]
    labels: Mapped[int]
    status: Mapped[str] = mapped_column(String(12))
    stages: Mapped[list[object]]
    model_error: Mapped[dict[str, object] | None]
    diagnostics: Mapped[dict[str, object] | None]
    job_id: Mapped[UUID | None]
    error: Mapped[str | None]
    created_at: Mapped[datetime]
    finished_at: Mapped[datetime | None]
    __table_args__ = (
        Index("uq_round_number", "project_id", "number", unique=True),
        Index(
            "uq_round_current",
            "project_id",
            unique=True,
            sqlite_where=text("status = 'current'"),
            postgresql_where=text("status = 'current'"),
        ),
    )


class ModelVersionRow(Row):
    """A trained network; its weights are the blob `sha256`."""

    __tablename__ = "model_version"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"), index=True)
    round_id: Mapped[UUID | None] = mapped_column(ForeignKey("round.id"))
    kind: Mapped[str] = mapped_column(String(40))
    member: Mapped[int] = mapped_column(default=0)
    family: Mapped[str] = mapped_column(String(40))
    config: Mapped[dict[str, object]]
    sha256: Mapped[str] = mapped_column(String(64))
    bytes: Mapped[int]
    watermark: Mapped[int]
    metrics: Mapped[dict[str, object]]
    created_at: Mapped[datetime]
    __table_args__ = (Index("uq_model_version_stage", "round_id", "kind", "member", unique=True),)


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


class EventRow(Row):
    """Something that happened: who, when, what. `transaction` tells readers what may still be committed before it."""

    __tablename__ = "event"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    project_id: Mapped[UUID | None]
    kind: Mapped[str] = mapped_column(String(60))
    data: Mapped[dict[str, object]]
    actor: Mapped[str] = mapped_column(String(200), default="")
    correlation: Mapped[str] = mapped_column(String(100), default="")
    transaction: Mapped[int] = mapped_column(BigInteger, default=CurrentTransaction())
    created_at: Mapped[datetime]
    __table_args__ = (
        Index("ix_event_project", "project_id", "transaction", "id"),
        Index("ix_event_order", "transaction", "id"),
    )


class EventEpochRow(Row):
    """One row: `added` to the numbers of the database server's transactions, which another server counts anew."""

    __tablename__ = "event_epoch"
    id: Mapped[int] = mapped_column(primary_key=True)
    added: Mapped[int] = mapped_column(BigInteger)


class IdempotencyRow(Row):
    """The answer to a request that carried an Idempotency-Key, kept so that a repetition gets the same one.

    It is written in the transaction of what the request did: both are there, or neither.
    """

    __tablename__ = "idempotency"
    caller: Mapped[str] = mapped_column(String(40), primary_key=True)
    route: Mapped[str] = mapped_column(String(40), primary_key=True)
    key: Mapped[str] = mapped_column(String(200), primary_key=True)
    request_sha256: Mapped[str] = mapped_column(String(64))
    status: Mapped[int | None]
    location: Mapped[str | None] = mapped_column(String(200))
    body: Mapped[str | None]
    expires_at: Mapped[datetime] = mapped_column(index=True)


class KeyRow(Row):
    """An API key: the hash of its secret and what it may do."""

    __tablename__ = "api_key"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    name: Mapped[str] = mapped_column(String(200))
    secret_sha256: Mapped[str] = mapped_column(String(64))
    scopes: Mapped[list[object]]
    created_at: Mapped[datetime]


class WorkerRow(Row):
    """A worker process: which queues it serves and when it was last heard."""

    __tablename__ = "worker"
    owner: Mapped[str] = mapped_column(String(120), primary_key=True)
    queues: Mapped[list[object]]
    heartbeat_at: Mapped[datetime]
