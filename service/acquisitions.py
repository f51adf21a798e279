"""Acquisitions: batches of segments given out under a lease, from a ranked queue that a scoring job made."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from uuid import UUID

import numpy as np
from sqlalchemy.orm import Session

from api_schemas.acquisitions import AcquireRequest, Acquisition, AcquisitionItem
from api_schemas.strategies import STRATEGY_NAMES
from service import events, projects, scorings
from service.errors import (
    BudgetExhausted,
    InvalidLeaseToken,
    LeaseLost,
    PoolExhausted,
    UnknownResource,
    UnknownStrategy,
)
from service.store.queries import acquisitions as queries
from service.store.queries import pool as pool_queries
from service.store.tables import AcquisitionItemRow, AcquisitionRow, ClaimRow, JobRow, ProjectRow


@dataclass(frozen=True)
class Candidate:
    """A segment about to be given out."""

    trajectory: str
    start: int
    score: float | None


@dataclass(frozen=True)
class Draw:
    """What a batch is made of, and who ranked it."""

    strategy: str
    round_id: UUID | None
    candidates: Sequence[Candidate]


def acquire(
    session: Session, request: AcquireRequest, now: datetime, limits: scorings.Limits
) -> AcquisitionRow | JobRow:
    """The next batch, or the job to wait for where no ranked queue is ready.

    Raises UnknownResource, UnknownStrategy, PoolExhausted, BudgetExhausted.
    """
    project = projects.find(session, request.project, lock=True)
    policy = projects.policy_of(project)
    requested = _known(request.strategy or policy.strategy)
    _check_counts(session, project, request, now)
    if request.purpose == "held_out":
        drawn: Draw | JobRow = Draw("random", None, _draw_held_out(session, project, request.count, now))
    else:
        drawn = _draw_ranked(session, project, requested, request.count, now, limits)
    if isinstance(drawn, JobRow):
        return drawn
    return _lease(session, project, request, requested, drawn, now)


def extend(session: Session, acquisition_id: UUID, token: int, seconds: float | None, now: datetime) -> AcquisitionRow:
    """Move the lease's end. What another has claimed meanwhile stays theirs. Raises InvalidLeaseToken, LeaseLost."""
    row = _held(session, acquisition_id, token)
    if not queries.claims_of(session, row.id, token):
        raise LeaseLost(row.id, "its segments are labeled or held by others by now")
    row.lease_expires_at = now + timedelta(seconds=seconds or _lease_seconds(session, row))
    queries.extend_claims(session, row.id, token, row.lease_expires_at)
    events.record(session, row.project_id, "lease.extended", {"acquisition": str(row.id)}, now)
    return row


def release(session: Session, acquisition_id: UUID, token: int, now: datetime) -> AcquisitionRow:
    """Give the unlabeled segments back to the pool. Raises InvalidLeaseToken, LeaseLost."""
    row = _held(session, acquisition_id, token)
    for claim in queries.claims_of(session, row.id, token):
        session.delete(claim)
    row.status = "released"
    events.record(session, row.project_id, "lease.released", {"acquisition": str(row.id)}, now)
    return row


def find(session: Session, acquisition_id: UUID) -> AcquisitionRow:
    """The acquisition's row. Raises UnknownResource."""
    row = session.get(AcquisitionRow, acquisition_id)
    if row is None:
        raise UnknownResource("acquisition", acquisition_id)
    return row


def close_if_labeled(session: Session, row: AcquisitionRow, now: datetime) -> None:
    """An acquisition whose items are all labeled is labeled."""
    if row.status == "leased" and all(label for _, label in queries.items_with_labels(session, row.id)):
        row.status = "labeled"
        events.record(session, row.project_id, "acquisition.labeled", {"acquisition": str(row.id)}, now)


def describe(session: Session, row: AcquisitionRow, now: datetime, *, with_token: bool) -> Acquisition:
    """The acquisition as the API shows it; the token only to the one who has just acquired it."""
    project = projects.find(session, row.project_id)
    items = [
        AcquisitionItem(
            rank=item.rank,
            trajectory=item.trajectory_id,
            start=item.start,
            length=project.segment_length,
            score=item.score,
            labeled=label is not None,
        )
        for item, label in queries.items_with_labels(session, row.id)
    ]
    expired = row.status == "leased" and row.lease_expires_at <= now
    fields = {
        name: getattr(row, name)
        for name in ("id", "purpose", "strategy", "requested_strategy", "labeler", "lease_expires_at", "created_at")
    }
    return Acquisition(
        project=project.id,
        round=row.round_id,
        status="expired" if expired else row.status,  # type: ignore[arg-type]  # pydantic checks the literal
        token=row.token if with_token else None,
        items=items,
        budget=projects.budget_of(project, pool_queries.split_count(session, project.id, "pool", now)),
        **fields,
    )


def _known(strategy: str) -> str:
    if strategy not in STRATEGY_NAMES:
        raise UnknownStrategy("strategy", strategy, f"must be one of {', '.join(STRATEGY_NAMES)}")
    return strategy


def _check_counts(session: Session, project: ProjectRow, request: AcquireRequest, now: datetime) -> None:
    split = pool_queries.split_count(session, project.id, request.purpose, now)
    if request.count > split.free:
        raise PoolExhausted(request.count, split.free, request.purpose)
    budget = projects.budget_of(project, split)
    if request.purpose == "held_out" or budget.total is None or budget.remaining is None:
        return
    if request.count > budget.remaining:
        raise BudgetExhausted(request.count, budget.remaining, budget.total)


def _draw_ranked(
    session: Session, project: ProjectRow, requested: str, count: int, now: datetime, limits: scorings.Limits
) -> Draw | JobRow:
    scoring = scorings.usable(session, project, requested, now, limits)
    if isinstance(scoring, JobRow):
        return scoring
    free = queries.free_queue(session, scoring, count, now)
    if len(free) < count:
        return scorings.refill(session, project, scoring, count, now, limits)
    candidates = [Candidate(row.trajectory_id, row.start, row.score) for row in free]
    return Draw(scoring.strategy, scoring.round_id, candidates)


def _draw_held_out(session: Session, project: ProjectRow, count: int, now: datetime) -> list[Candidate]:
    """Uniform over the free held-out segments; the generator is seeded by the project and the lease's token."""
    taken = pool_queries.taken_starts(session, project.id, "held_out", now)
    free = [
        (member.trajectory_id, start)
        for member in pool_queries.memberships(session, project.id, "held_out")
        for start in range(0, member.segments * project.stride, project.stride)
        if start not in taken.get(member.trajectory_id, ())
    ]
    chosen = np.random.default_rng([project.seed, project.token]).choice(len(free), count, replace=False)
    return [Candidate(free[i][0], free[i][1], None) for i in chosen]


def _lease(
    session: Session, project: ProjectRow, request: AcquireRequest, requested: str, draw: Draw, now: datetime
) -> AcquisitionRow:
    project.token += 1
    seconds = request.lease_seconds or projects.policy_of(project).lease_seconds
    row = AcquisitionRow(
        project_id=project.id,
        purpose=request.purpose,
        strategy=draw.strategy,
        requested_strategy=requested,
        round_id=draw.round_id,
        status="leased",
        labeler=request.labeler,
        token=project.token,
        lease_expires_at=now + timedelta(seconds=seconds),
        created_at=now,
    )
    session.add(row)
    session.flush()
    session.add_all([_item(row, rank, candidate) for rank, candidate in enumerate(draw.candidates)])
    queries.take_claims(session, [_claim(row, candidate) for candidate in draw.candidates])
    data = {"acquisition": str(row.id), "count": request.count, "strategy": row.strategy, "labeler": row.labeler}
    events.record(session, project.id, "lease.given", data, now)
    session.flush()
    return row


def _item(row: AcquisitionRow, rank: int, candidate: Candidate) -> AcquisitionItemRow:
    return AcquisitionItemRow(
        acquisition_id=row.id,
        rank=rank,
        trajectory_id=candidate.trajectory,
        start=candidate.start,
        score=candidate.score,
    )


def _claim(row: AcquisitionRow, candidate: Candidate) -> ClaimRow:
    return ClaimRow(
        project_id=row.project_id,
        trajectory_id=candidate.trajectory,
        start=candidate.start,
        acquisition_id=row.id,
        purpose=row.purpose,
        token=row.token,
        expires_at=row.lease_expires_at,
    )


def _held(session: Session, acquisition_id: UUID, token: int) -> AcquisitionRow:
    row = find(session, acquisition_id)
    projects.find(session, row.project_id, lock=True)
    if token != row.token:
        raise InvalidLeaseToken(row.id, token)
    if row.status != "leased":
        raise LeaseLost(row.id, f"it is {row.status}")
    return row


def _lease_seconds(session: Session, row: AcquisitionRow) -> float:
    return projects.policy_of(projects.find(session, row.project_id)).lease_seconds
