"""Scorings of a pool that are started by hand, as often as a test needs them."""

from collections.abc import Sequence
from dataclasses import dataclass
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load
from sqlalchemy import func, select

from service import projects, rounds, scorings
from service.clock import utc_now
from service.scorings import Limits
from service.store.blobs import Blobs
from service.store.tables import JobRow, MembershipRow, ScoringRow, ShardRow
from tests.crash.deployment import Deployment
from tests.loop.processes import eventually

SHARD_SEGMENTS = 150  # of a pool of 1,200: eight tasks
SCORED_SECONDS = 60.0


@dataclass(frozen=True)
class Scores:
    """What a scoring says of a pool: scores (N,), and for each the membership and the place in it."""

    scores: NDArray[np.float32]
    segments: list[tuple[int, int]]


def start_scoring(deployment: Deployment, project_id: UUID, strategy: str = "cycle") -> UUID:
    """Score the pool again under the round in use, whose scores are there already."""
    current = deployment.client.project(project_id).current_round
    assert current is not None
    limits = Limits(queue_length=400, shard_segments=SHARD_SEGMENTS, max_attempts=30)
    with deployment.database.write() as session:
        project = projects.find(session, project_id, lock=True)
        round_row = rounds.find(session, current)
        return scorings.start(session, project, strategy, round_row, utc_now(), limits).id


def scored_shards(deployment: Deployment, scoring: UUID) -> int:
    """How many shards have scores."""
    statement = select(func.count()).where(ShardRow.scoring_id == scoring, ShardRow.blob_sha256.is_not(None))
    with deployment.database.read() as session:
        return session.scalar(statement) or 0


def jobs_of(deployment: Deployment, scoring: UUID, kind: str) -> Sequence[JobRow]:
    """The scoring's jobs of one kind."""
    with deployment.database.read() as session:
        statement = select(JobRow).where(JobRow.subject_id == scoring, JobRow.kind == kind)
        return session.scalars(statement.order_by(JobRow.created_at)).all()


def await_ready(deployment: Deployment, scoring: UUID) -> None:
    """Wait until the scoring's queue may be used."""

    def ready() -> bool:
        with deployment.database.read() as session:
            return session.get_one(ScoringRow, scoring).status == "ready"

    eventually(ready, SCORED_SECONDS, lambda: f"scoring {scoring} is not ready: {deployment.last_words()}")


def read_scores(deployment: Deployment, scoring: UUID) -> Scores:
    """All shards of a scoring, one after the other."""
    blobs = Blobs(str(deployment.folder / "blobs"))
    with deployment.database.read() as session:
        statement = select(ShardRow.blob_sha256).where(ShardRow.scoring_id == scoring).order_by(ShardRow.number)
        shards = [load(blobs.get("scores", sha256)) for sha256 in session.scalars(statement) if sha256]
    segments = [
        (member, number)
        for shard in shards
        for member, count in zip(shard["members"].tolist(), shard["counts"].tolist(), strict=True)
        for number in range(count)
    ]
    return Scores(np.concatenate([shard["scores"] for shard in shards]), segments)


def segments_of_pool(deployment: Deployment, project_id: UUID) -> list[tuple[int, int]]:
    """Every segment of the pool once."""
    statement = select(MembershipRow).where(MembershipRow.project_id == project_id, MembershipRow.split == "pool")
    with deployment.database.read() as session:
        rows = session.scalars(statement.order_by(MembershipRow.id))
        return [(row.id, number) for row in rows for number in range(row.segments)]
