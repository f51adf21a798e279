"""Scores and the ranked queues that come of them."""

from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from service.store.columns import Row


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
