"""Scorings: the scores of one strategy over the pool, and the ranked queue selected from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from api_schemas.jobs import MergeScores, ScoreShard, SelectQueue, TrainRound
from api_schemas.labels import Action
from api_schemas.strategies import CATALOG, COLD_START_STRATEGY
from service import events, jobs
from service.errors import UnknownResource
from service.settings import Settings
from service.store.queries import acquisitions as queries
from service.store.queries import jobs as job_queries
from service.store.queries import pool as pool_queries
from service.store.queries import rounds as round_queries
from service.store.queries import rows
from service.store.tables import JobRow, ProjectRow, QueueRow, RoundRow, ScoringRow, ShardRow

NEEDS: dict[str, frozenset[str]] = {strategy.name: frozenset(strategy.needs) for strategy in CATALOG}
PREVIOUS = "previous_world_model"  # the one network that a round does not train: the round before has


@dataclass(frozen=True)
class Limits:
    """queue_length: ranked segments kept ready. shard_segments: how many segments one task scores."""

    queue_length: int
    shard_segments: int
    max_attempts: int = 3


def limits_of(settings: Settings) -> Limits:
    """The bounds that the settings give."""
    return Limits(settings.queue_length, settings.shard_transitions, settings.job_max_attempts)


@dataclass(frozen=True)
class Ranked:
    """A segment at its place in the queue, or an observation and the actions to execute from it on."""

    trajectory: str
    start: int
    score: float
    actions: Sequence[Action] | None = None
    confidence: float | None = None


def ready(session: Session, project: ProjectRow, requested: str) -> ScoringRow | None:
    """The scoring whose queue may be read at once; None where `usable` has something to start or to wait for."""
    strategy, round_row = ranking(session, project, requested)
    found = queries.newest_ready(session, project.id, strategy, round_row.id if round_row else None)
    if found is None:
        return None
    newest, member = found
    return None if round_row is None and newest.memberships < member else newest


def usable(session: Session, project: ProjectRow, requested: str, now: datetime, limits: Limits) -> ScoringRow | JobRow:
    """A scoring whose queue is ready, or the job that will make one.

    Before the first round a strategy that needs models falls back on COLD_START_STRATEGY. A model's scores hold for
    the pool as it was scored; a model-free scoring is made anew when the pool has grown, while the old queue serves on.
    """
    strategy, round_row = ranking(session, project, requested)
    newest = queries.newest_scoring(session, project.id, strategy, round_row.id if round_row else None)
    if newest is None:
        return _request(session, project, strategy, round_row, now, limits)
    if newest.status == "ready" and round_row is None and _outgrown(session, newest):
        start(session, project, strategy, None, now, limits)  # for later; the queue that is there serves meanwhile
    if newest.status == "ready":
        return newest
    ready = queries.newest_scoring(session, project.id, strategy, newest.round_id, "ready")
    return ready or _waiting(session, newest, now, limits)


def start(
    session: Session, project: ProjectRow, strategy: str, round_row: RoundRow | None, now: datetime, limits: Limits
) -> ScoringRow:
    """Cut the pool into shards and queue one job for each."""
    members = pool_queries.sizes(session, project.id, "pool")
    cuts = _cut(members, limits.shard_segments)
    scoring = ScoringRow(
        project_id=project.id,
        round_id=round_row.id if round_row else None,
        strategy=strategy,
        status="scoring",
        memberships=members[-1][0] if members else 0,
        shards=len(cuts),
        created_at=now,
    )
    session.add(scoring)
    session.flush()
    tell(session, scoring, "started", now, shards=len(cuts))
    for number, (first, last) in enumerate(cuts):
        session.add(ShardRow(scoring_id=scoring.id, number=number, first=first, last=last))
        payload = ScoreShard(scoring=scoring.id, shard=number)
        jobs.enqueue(session, project.id, payload, scoring.id, now, limits.max_attempts)
    if not cuts:
        _merge(session, scoring, now, limits)
    return scoring


def refill(
    session: Session, project: ProjectRow, scoring: ScoringRow, count: int, now: datetime, limits: Limits
) -> JobRow:
    """A job that makes the queue long enough for `count`: it selects again from the stored scores.

    Where the pool has outgrown them it is scored again: the free segments may be among those without a score.
    """
    waiting = job_queries.unfinished(session, scoring.id)
    if waiting is not None:
        return waiting
    newest = queries.newest_scoring(session, project.id, scoring.strategy, scoring.round_id)
    if newest is not None and newest.status == "scoring":
        return _waiting(session, newest, now, limits)
    if _outgrown(session, scoring):
        round_row = session.get(RoundRow, scoring.round_id) if scoring.round_id else None
        return _waiting(session, start(session, project, scoring.strategy, round_row, now, limits), now, limits)
    payload = SelectQueue(scoring=scoring.id, length=max(limits.queue_length, count))
    return jobs.enqueue(session, scoring.project_id, payload, scoring.id, now, limits.max_attempts)


def shard_scored(
    session: Session, scoring_id: UUID, number: int, blob_sha256: str, now: datetime, limits: Limits
) -> None:
    """Note a shard's scores; the last of them asks for the merge, once."""
    scoring = find(session, scoring_id, lock=True)
    shard = session.get(ShardRow, (scoring_id, number))
    if shard is None:
        raise UnknownResource(f"shard of scoring {scoring_id}", number)
    fresh = shard.blob_sha256 is None
    shard.blob_sha256 = blob_sha256
    session.flush()
    if fresh and queries.unscored_shards(session, scoring_id) == 0:
        _merge(session, scoring, now, limits)


def publish(session: Session, scoring_id: UUID, ranked: Sequence[Ranked], now: datetime) -> ScoringRow:
    """The queue becomes `ranked`, and the scoring is ready."""
    scoring = find(session, scoring_id, lock=True)
    rows = [
        QueueRow(
            scoring_id=scoring.id,
            rank=rank,
            project_id=scoring.project_id,
            trajectory_id=segment.trajectory,
            start=segment.start,
            score=segment.score,
            confidence=segment.confidence,
            actions=None if segment.actions is None else list(segment.actions),
        )
        for rank, segment in enumerate(ranked)
    ]
    queries.replace_queue(session, scoring, rows)
    scoring.status = "ready"
    scoring.selections += 1
    tell(session, scoring, "ready", now, queued=len(ranked))
    return scoring


def find(session: Session, scoring_id: UUID, *, lock: bool = False) -> ScoringRow:
    """The scoring's row. Raises UnknownResource."""
    row = rows.get(session, ScoringRow, scoring_id, lock=lock)
    if row is None:
        raise UnknownResource("scoring", scoring_id)
    return row


def fail(session: Session, scoring_id: UUID, now: datetime) -> None:
    """A scoring whose job gave up is not used; the next acquire starts another."""
    scoring = find(session, scoring_id, lock=True)
    if scoring.status != "failed":
        scoring.status = "failed"
        tell(session, scoring, "failed", now)


def tell(session: Session, scoring: ScoringRow, what: str, now: datetime, **more: object) -> None:
    """An event of a scoring."""
    data = {"scoring": str(scoring.id), "strategy": scoring.strategy, "mode": scoring.mode, **more}
    events.record(session, scoring.project_id, f"scoring.{what}", data, now)


def ranking(session: Session, project: ProjectRow, requested: str) -> tuple[str, RoundRow | None]:
    """The strategy that ranks, and the round under whose models; a cold start has neither round nor choice."""
    current = round_queries.current_round(session, project.id)
    strategy = requested if current or not NEEDS[requested] else COLD_START_STRATEGY
    return strategy, current if NEEDS[strategy] else None


def _request(
    session: Session, project: ProjectRow, strategy: str, round_row: RoundRow | None, now: datetime, limits: Limits
) -> JobRow:
    """Score with the current round's networks, which are trained first where this strategy needs more of them."""
    have = {model.kind for model in round_queries.models_of(session, round_row.id)} if round_row else set()
    if round_row is not None and not NEEDS[strategy] - {PREVIOUS} <= have:
        waiting = job_queries.unfinished(session, round_row.id)
        payload = TrainRound.model_validate({"round": round_row.id, "strategy": strategy})
        return waiting or jobs.enqueue(session, project.id, payload, round_row.id, now, limits.max_attempts)
    scoring = start(session, project, strategy, round_row, now, limits)
    return _waiting(session, scoring, now, limits)


def _outgrown(session: Session, scoring: ScoringRow) -> bool:
    return scoring.memberships < pool_queries.newest_membership(session, scoring.project_id, "pool")


def _waiting(session: Session, scoring: ScoringRow, now: datetime, limits: Limits) -> JobRow:
    """The job that works on a scoring that is not ready yet."""
    return job_queries.unfinished(session, scoring.id) or _merge(session, scoring, now, limits)


def _merge(session: Session, scoring: ScoringRow, now: datetime, limits: Limits) -> JobRow:
    payload = MergeScores(scoring=scoring.id)
    return jobs.enqueue(session, scoring.project_id, payload, scoring.id, now, limits.max_attempts)


def _cut(members: Sequence[tuple[int, int]], shard_segments: int) -> list[tuple[int, int]]:
    """(first, last) membership ids of runs that hold about `shard_segments` segments each."""
    cuts: list[tuple[int, int]] = []
    first, size = None, 0
    for member_id, segments in members:
        first, size = member_id if first is None else first, size + segments
        if size >= shard_segments:
            cuts.append((first, member_id))
            first, size = None, 0
    return cuts if first is None else [*cuts, (first, members[-1][0])]
