"""Scoring: shards of the pool are scored apart, merged once, and ordered into the queue that acquire gives from."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple
from uuid import UUID

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from api_schemas.jobs import ScoreShard
from models.acquisition import BATCH_RULES, STRATEGIES, Models, confidence, describe, score_pool
from models.chance import scoring_generator
from service import projects, rounds, scorings
from service.log import get_logger
from service.scorings import Ranked
from service.store.blobs import Blobs
from service.store.database import Database
from service.store.queries import acquisitions as queries
from service.store.queries import pool as pool_queries
from service.store.queries import rounds as round_queries
from service.store.tables import MembershipRow, ProjectRow, ScoringRow, ShardRow
from workers import data
from workers.evaluation import load_network
from workers.job import RunningJob

log = get_logger("worker")
QUEUE_BYTES = 2**30  # of the candidates' observations: a queue of long image segments is shorter than the settings say


@dataclass(frozen=True)
class PoolScores:
    """Scores of all segments of a scoring, aligned: (N,) float32, membership ids (N,), starts (N,)."""

    scores: NDArray[np.float32]
    members: NDArray[np.int64]
    starts: NDArray[np.int64]


def run_shard(job: RunningJob, payload: ScoreShard) -> dict[str, object]:
    """Score one shard of the pool; a shard that has its scores is left alone."""
    with job.worker.database.read() as session:
        scoring = scorings.find(session, payload.scoring)
        project = projects.find(session, scoring.project_id)
        shard = session.get_one(ShardRow, (scoring.id, payload.shard))
        members = pool_queries.memberships(session, project.id, "pool", shard.first, shard.last)
        members = [member for member in members if member.segments]
        windows = data.windows_of(session, project, members, None) if scorings.NEEDS[scoring.strategy] else []
        generator = _generator(session, project, scoring, f"shard {payload.shard}")
    if shard.blob_sha256 is not None or scoring.status == "failed":  # failed: nobody will read these scores
        return {"scored": 0}
    if windows:
        scores = _scores(job, project, scoring, windows, generator)
    else:  # a strategy that needs no model needs no observation either
        scores = torch.rand(sum(member.segments for member in members), generator=generator).numpy()
    sha256 = job.worker.blobs.put("scores", _pack(project, members, scores))
    with job.transaction() as session:
        limits = scorings.limits_of(job.worker.settings)
        scorings.shard_scored(session, scoring.id, payload.shard, sha256, job.now(), limits)
    return {"scored": len(scores)}


def run_selection(job: RunningJob, scoring_id: UUID, length: int) -> dict[str, object]:
    """Order the best free segments so that every prefix is a good batch, and publish them as the queue.

    The candidates are the `length` highest scores among segments that are neither labeled nor leased now.
    """
    with job.worker.database.read() as session:
        scoring = scorings.find(session, scoring_id)
        project = projects.find(session, scoring.project_id)
        shas = [shard.blob_sha256 for shard in queries.shards(session, scoring.id)]
        taken = pool_queries.taken_starts(session, project.id, "pool", job.now())
        members = {row.id: row for row in pool_queries.memberships(session, project.id, "pool")}
    pool = _unpack(job.worker.blobs, [sha for sha in shas if sha is not None], job.go_on)
    if scorings.NEEDS[scoring.strategy]:  # what is ordered by models is read first
        length = data.fitting(project, length, QUEUE_BYTES)
    candidates = _candidates(pool, members, taken, length)
    job.report(0.3, f"selecting from {len(candidates)} candidates")
    ordered = _ordered(job, project, scoring, pool, candidates, members)
    ranked = [
        Ranked(members[int(pool.members[i])].trajectory_id, int(pool.starts[i]), float(pool.scores[i]), confidence=sure)
        for i, sure in zip(candidates[ordered.places], ordered.confidence, strict=True)
    ]
    with job.transaction() as session:
        published = scorings.publish(session, scoring.id, ranked, job.now())
        if published.round_id is not None:
            rounds.make_current(session, published.round_id, job.now())
    _note_sizes(job)
    return {"queued": len(ranked), "pool": len(pool.scores)}


def _note_sizes(job: RunningJob) -> None:
    """The queue is published and good; this makes it quicker only."""
    try:
        with job.worker.database.write() as session:
            queries.note_sizes(session)
    except SQLAlchemyError as error:
        log.warning("sizes_not_noted", error=str(error))


def load_models(
    database: Database, blobs: Blobs, project: ProjectRow, round_id: UUID | None, needs: frozenset[str]
) -> Models:
    """Of the networks that a round has trained so far those that are needed, the previous round's world model too.

    Call it outside of any transaction: the store may take minutes.
    """
    with database.read() as session:
        rows = [(row.kind, row) for row in (round_queries.models_of(session, round_id) if round_id else [])]
        if round_id and scorings.PREVIOUS in needs:
            previous = round_queries.previous_world_model(session, rounds.find(session, round_id))
            rows += [] if previous is None else [(scorings.PREVIOUS, previous)]
    networks = [(kind, load_network(blobs, row, project)) for kind, row in rows if kind in needs]
    single = {kind: network for kind, network in networks if kind != "ensemble"}
    ensemble = tuple(network for kind, network in networks if kind == "ensemble")
    return Models(**single, ensemble=ensemble)  # type: ignore[arg-type]  # kinds are the fields of Models


def _load(job: RunningJob, project: ProjectRow, scoring: ScoringRow) -> Models:
    needs = scorings.NEEDS[scoring.strategy]
    return load_models(job.worker.database, job.worker.blobs, project, scoring.round_id, needs)


def _scores(
    job: RunningJob,
    project: ProjectRow,
    scoring: ScoringRow,
    windows: Sequence[data.Windows],
    generator: torch.Generator,
) -> NDArray[np.float32]:
    models = _load(job, project, scoring)
    total = sum(len(window.starts) for window in windows)
    parts: list[torch.Tensor] = []
    for batch in data.chunks(job.worker.blobs, project, windows, job.go_on):
        parts.append(score_pool(STRATEGIES[scoring.strategy], models, batch, generator, after_each=job.go_on))
        done = sum(len(part) for part in parts)
        job.report(done / total, f"scored {done} of {total} segments with {scoring.strategy}")
    return torch.cat(parts).float().numpy()


class Ordered(NamedTuple):
    """Places in the candidates, best first, and how sure the strategy's inverse dynamics is there, if it has one."""

    places: NDArray[np.int64]
    confidence: Sequence[float | None]


def _ordered(
    job: RunningJob,
    project: ProjectRow,
    scoring: ScoringRow,
    pool: PoolScores,
    candidates: NDArray[np.int64],
    members: dict[int, MembershipRow],
) -> Ordered:
    """As the policy's batch rule has it where the strategy has models; else the order is a draw already."""
    rule, strategy = BATCH_RULES[projects.policy_of(project).batch_rule], STRATEGIES[scoring.strategy]
    if not strategy.needs or not len(candidates):
        return Ordered(np.arange(len(candidates)), [None] * len(candidates))
    with job.worker.database.read() as session:
        windows = _candidate_windows(session, project, pool, candidates, members)
        generator = _generator(session, project, scoring, f"selection {scoring.selections}")
    models = _load(job, project, scoring)
    batch = data.load_in_order(job.worker.blobs, windows, project.segment_length, job.go_on)
    job.report(0.6, f"ordering {len(candidates)} candidates by {rule.name}")
    described = describe(rule, strategy, models, batch, torch.from_numpy(pool.scores[candidates]))
    order: NDArray[np.int64] = rule.order(described, len(candidates), generator).numpy()
    sure = confidence(strategy, models, batch)
    return Ordered(order, [None] * len(order) if sure is None else sure[torch.from_numpy(order)].tolist())


def _candidate_windows(
    session: Session,
    project: ProjectRow,
    pool: PoolScores,
    candidates: NDArray[np.int64],
    members: dict[int, MembershipRow],
) -> list[data.Windows]:
    rows = [members[int(pool.members[i])] for i in candidates]
    contents = pool_queries.contents(session, sorted({row.trajectory_id for row in rows}))
    return [
        data.Windows(row.trajectory_id, contents[row.trajectory_id].blob_sha256, (int(pool.starts[i]),))
        for row, i in zip(rows, candidates, strict=True)
    ]


def _candidates(
    pool: PoolScores, members: dict[int, MembershipRow], taken: dict[str, set[int]], length: int
) -> NDArray[np.int64]:
    """Indices of the `length` highest free scores, highest first; equal scores keep the pool's order."""
    gone = {(member_id, start) for member_id, row in members.items() for start in taken.get(row.trajectory_id, ())}
    free = np.array([key not in gone for key in zip(pool.members.tolist(), pool.starts.tolist(), strict=True)], bool)
    ranked = np.argsort(-pool.scores, kind="stable")
    best: NDArray[np.int64] = ranked[free[ranked]][:length]
    return best


def _pack(project: ProjectRow, members: Sequence[MembershipRow], scores: NDArray[np.float32]) -> bytes:
    """One row a segment would be a table as large as the pool; an array is four bytes a segment."""
    counts = np.array([member.segments for member in members], np.int64)
    ids = np.array([member.id for member in members], np.int64)
    return save_arrays({"scores": scores, "members": ids, "counts": counts, "stride": np.array([project.stride])})


def _unpack(blobs: Blobs, shas: Sequence[str], after_each: Callable[[], None] = lambda: None) -> PoolScores:
    shards = []
    for sha in shas:
        shards.append(load_arrays(blobs.get("scores", sha)))
        after_each()
    if not shards:
        return PoolScores(np.empty(0, np.float32), np.empty(0, np.int64), np.empty(0, np.int64))
    starts = [np.concatenate([np.arange(n) * int(s["stride"][0]) for n in s["counts"]]) for s in shards]
    return PoolScores(
        np.concatenate([s["scores"] for s in shards]),
        np.concatenate([np.repeat(s["members"], s["counts"]) for s in shards]),
        np.concatenate(starts).astype(np.int64),
    )


def _generator(session: Session, project: ProjectRow, scoring: ScoringRow, what: str) -> torch.Generator:
    number = rounds.find(session, scoring.round_id).number if scoring.round_id else 0
    size = len(pool_queries.memberships(session, project.id, "pool", last=scoring.memberships))
    return scoring_generator(project.seed, scoring.strategy, number, size, what)
