"""Acquisitions: batches given out under a lease: segments of a ranked queue, held-out segments, or explorations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import cast
from uuid import UUID

from sqlalchemy.orm import Session

from api_schemas.acquisitions import AcquireRequest, Acquisition, AcquisitionItem
from api_schemas.labels import Action
from api_schemas.projects import Budget
from api_schemas.strategies import STRATEGY_NAMES
from service import draws, events, leases, projects, proposals, scorings
from service.clock import Clock
from service.draws import Candidate, PoolExhausted
from service.errors import UnknownStrategy
from service.leases import BudgetExhausted
from service.proposals import NothingToExplore
from service.store.queries import acquisitions as queries
from service.store.queries import pool as pool_queries
from service.store.queries.acquisitions import Queued
from service.store.queries.pool import Leased
from service.store.tables import (
    AcquisitionItemRow,
    AcquisitionRow,
    JobRow,
    ProjectRow,
    QueueRow,
    RoundRow,
    ScoringRow,
)


@dataclass(frozen=True)
class Draw:
    """What a batch is made of, who ranked it, and why it is smaller than was asked for.

    scoring: of the queue that it is from, if any; locked: the ranks there of rows that this transaction has locked.
    """

    strategy: str
    candidates: Sequence[Candidate]
    reason: str | None = None
    scoring: ScoringRow | None = None
    locked: Sequence[int] = ()


@dataclass(frozen=True)
class Room:
    """How many items can be given out, and what stands in the way of more."""

    count: int
    reason: str | None = None


def acquire(session: Session, request: AcquireRequest, clock: Clock, limits: scorings.Limits) -> Acquisition | JobRow:
    """The next batch, as who asked for it is told, or the job to wait for where no ranked queue is ready.

    Whoever asks at the same time reads other rows of the queue (SKIP LOCKED); under the project's lock, which all take
    one after the other for the short rest, nothing is given out that another has taken meanwhile. What time it is, too,
    is asked under the lock: waiting for it takes time.
    Raises UnknownResource, UnknownStrategy, PrivilegedStrategy, PoolExhausted, BudgetExhausted.
    """
    project = projects.find(session, request.project)
    requested = _known(project, request.strategy or projects.policy_of(project).strategy)
    ranked = request.purpose == "pool" and request.mode == "pool"
    first = _front_of_queue(session, project, requested, request.count, clock()) if ranked else None
    chooses = proposals.proposing(session, project, requested) if request.mode == "explore" else None
    states = draws.states(session, project) if request.mode == "explore" and chooses is None else None
    project, now = projects.find(session, request.project, lock=True), clock()
    leased = pool_queries.leased(session, project.id, now)
    room = _room(project, request, leased)
    if chooses is not None:
        drawn: Draw | JobRow = _draw_proposals(session, project, requested, chooses, room, now, limits)
    elif states is not None:
        drawn = _draw_explorations(project, states, room)
    elif request.purpose == "held_out":
        drawn = Draw("random", draws.held_out(session, project, room.count, now), reason=room.reason)
    else:
        drawn = _draw_ranked(session, project, requested, room, first, now, limits)
    if isinstance(drawn, JobRow):
        return drawn
    row = _lease(session, project, request, requested, drawn, now)
    budget = projects.budget_of(project, _with(leased, row, len(drawn.candidates)))
    items = [_item(project, rank, candidate) for rank, candidate in enumerate(drawn.candidates)]
    return _told(project, row, items, budget, now, with_token=True)


def describe(session: Session, row: AcquisitionRow, now: datetime, *, with_token: bool) -> Acquisition:
    """The acquisition as the API shows it; the token only to the one who has just acquired it."""
    project = projects.find(session, row.project_id)
    budget = projects.budget_of(project, pool_queries.leased(session, project.id, now))
    items = [_kept_item(project, item, label) for item, label in queries.items_with_labels(session, row.id)]
    return _told(project, row, items, budget, now, with_token=with_token)


def _told(
    project: ProjectRow,
    row: AcquisitionRow,
    items: list[AcquisitionItem],
    budget: Budget,
    now: datetime,
    *,
    with_token: bool,
) -> Acquisition:
    expired = row.status == "leased" and row.lease_expires_at <= now
    fields = {
        name: getattr(row, name)
        for name in (
            *("id", "mode", "purpose", "strategy", "requested_strategy", "reason", "labeler"),
            *("lease_expires_at", "created_at"),
        )
    }
    return Acquisition(
        project=project.id,
        round=row.round_id,
        status="expired" if expired else row.status,  # type: ignore[arg-type]  # pydantic checks the literal
        token=row.token if with_token else None,
        items=items,
        budget=budget,
        **fields,
    )


def _known(project: ProjectRow, strategy: str) -> str:
    if strategy not in STRATEGY_NAMES:
        raise UnknownStrategy("strategy", strategy, f"must be one of {', '.join(STRATEGY_NAMES)}")
    projects.refuse_unfit("strategy", strategy, projects.spaces_of(project))
    return strategy


def _front_of_queue(
    session: Session, project: ProjectRow, strategy: str, count: int, now: datetime
) -> tuple[ScoringRow, Sequence[Queued]] | None:
    """The first free rows of the queue that nobody else reads at this moment, where a queue is ready."""
    scoring = scorings.ready(session, project, strategy)
    return None if scoring is None else (scoring, queries.free_queue(session, scoring, count, now, lock=True))


def _room(project: ProjectRow, request: AcquireRequest, leased: Leased) -> Room:
    """What of the asked count budget and split allow; call it under the project's lock."""
    room = Room(request.count)
    if request.mode == "pool":
        free = projects.split_count(project, request.purpose, leased).free
        if free < 1:
            raise PoolExhausted(request.count, 0, request.purpose)
        if free < room.count:
            room = Room(free, f"{request.count} were asked for, {free} are left in the {request.purpose} split")
    budget = projects.budget_of(project, leased)
    if request.purpose == "held_out" or budget.total is None or budget.remaining is None:
        return room
    if budget.remaining < 1:
        raise BudgetExhausted(request.count, budget.remaining, budget.total)
    if budget.remaining < room.count:
        reason = f"{request.count} were asked for, {budget.remaining} of the budget of {budget.total} labels remain"
        room = Room(budget.remaining, reason)
    return room


def _draw_ranked(
    session: Session,
    project: ProjectRow,
    requested: str,
    room: Room,
    first: tuple[ScoringRow, Sequence[Queued]] | None,
    now: datetime,
    limits: scorings.Limits,
) -> Draw | JobRow:
    if first is not None:
        scoring, rows = first
        free = queries.still_free(session, scoring, rows, now)
        rows = [row for row in rows if row.rank in free][: room.count]
        if len(rows) == room.count:
            return replace(_ranked(scoring, rows, room), locked=[row.rank for row in rows])
    # Others were faster, or the queue is short: look again, now that nobody moves.
    found = scorings.usable(session, project, requested, now, limits)
    if isinstance(found, JobRow):
        return found
    rows = queries.free_queue(session, found, room.count, now)
    if len(rows) < room.count:
        return scorings.refill(session, project, found, room.count, now, limits)
    return _ranked(found, rows, room)


def _ranked(scoring: ScoringRow, rows: Sequence[Queued], room: Room) -> Draw:
    candidates = [Candidate(row.trajectory, row.start, row.score, row.confidence) for row in rows]
    return Draw(scoring.strategy, candidates, room.reason, scoring)


def _draw_proposals(
    session: Session,
    project: ProjectRow,
    strategy: str,
    round_row: RoundRow,
    room: Room,
    now: datetime,
    limits: scorings.Limits,
) -> Draw | JobRow:
    """States and actions that the strategy proposes under the round's models."""
    taken = proposals.take(session, project, strategy, round_row, room.count, now, limits)
    if isinstance(taken, JobRow):
        return taken
    scoring, rows = taken
    left = f"{room.count} were asked for, {len(rows)} explorations were ready"
    candidates = [Candidate(row.trajectory_id, row.start, row.score, actions=_actions(row)) for row in rows]
    return Draw(strategy, candidates, room.reason if len(rows) == room.count else left, scoring)


def _actions(row: QueueRow) -> list[Action]:
    """To execute; a worker wrote them, one by one in the form of labels."""
    return cast(list[Action], row.actions)


def _draw_explorations(project: ProjectRow, states: draws.States, room: Room) -> Draw:
    """States of the pool and actions to execute there, both drawn uniformly: there is no model that proposes any."""
    candidates = draws.explorations(project, states, room.count)
    if not candidates:
        raise NothingToExplore(project.id, projects.environment_of(project).simulator)
    return Draw("random", candidates, reason=room.reason)


def _lease(
    session: Session, project: ProjectRow, request: AcquireRequest, requested: str, draw: Draw, now: datetime
) -> AcquisitionRow:
    project.token += 1
    seconds = request.lease_seconds or projects.policy_of(project).lease_seconds
    row = AcquisitionRow(
        project_id=project.id,
        mode=request.mode,
        purpose=request.purpose,
        strategy=draw.strategy,
        requested_strategy=requested,
        round_id=draw.scoring.round_id if draw.scoring else None,
        status="leased",
        reason=draw.reason,
        labeler=request.labeler,
        token=project.token,
        lease_expires_at=now + timedelta(seconds=seconds),
        created_at=now,
    )
    session.add(row)
    session.flush()
    queries.add_items(session, [_item_row(row, rank, candidate) for rank, candidate in enumerate(draw.candidates)])
    queries.take_claims(session, [_claim_row(row, rank, candidate) for rank, candidate in enumerate(draw.candidates)])
    _pass_over(session, row, draw)
    data = {"acquisition": str(row.id), "count": len(draw.candidates), "strategy": row.strategy}
    events.record(session, project.id, "lease.given", data | {"labeler": row.labeler, "mode": row.mode}, now)
    return row


def _pass_over(session: Session, row: AcquisitionRow, draw: Draw) -> None:
    """Spare the next one a look at the claims of these. Rows that others may hold are left alone where they do."""
    if row.mode == "explore":  # claims no segment
        return
    if draw.scoring is not None and draw.locked:
        queries.note_leased(session, draw.scoring.id, draw.locked, row.lease_expires_at)
    elif draw.scoring is not None:
        segments = [(candidate.trajectory, candidate.start) for candidate in draw.candidates]
        queries.pass_over(session, row.project_id, segments, row.lease_expires_at)


def _with(leased: Leased, row: AcquisitionRow, count: int) -> Leased:
    """What is leased once this batch is, too."""
    kind = "explore" if row.mode == "explore" else row.purpose
    return leased._replace(**{kind: getattr(leased, kind) + count})


def _item_row(row: AcquisitionRow, rank: int, candidate: Candidate) -> dict[str, object]:
    return {
        "acquisition_id": row.id,
        "rank": rank,
        "trajectory_id": candidate.trajectory,
        "start": candidate.start,
        "score": candidate.score,
        "confidence": candidate.confidence,
        "actions": None if candidate.actions is None else list(candidate.actions),
    }


def _claim_row(row: AcquisitionRow, rank: int, candidate: Candidate) -> dict[str, object]:
    explores = row.mode == "explore"
    return {
        "project_id": row.project_id,
        "trajectory_id": leases.exploration_name(row.id) if explores else candidate.trajectory,
        "start": rank if explores else candidate.start,
        "acquisition_id": row.id,
        "purpose": "explore" if explores else row.purpose,
        "token": row.token,
        "expires_at": row.lease_expires_at,
    }


def _item(project: ProjectRow, rank: int, candidate: Candidate) -> AcquisitionItem:
    """An item that has just been drawn."""
    return AcquisitionItem(
        rank=rank,
        trajectory=candidate.trajectory,
        start=candidate.start,
        length=project.segment_length,
        score=candidate.score,
        confidence=candidate.confidence,
        labeled=False,
        actions=None if candidate.actions is None else list(candidate.actions),
    )


def _kept_item(project: ProjectRow, row: AcquisitionItemRow, label: UUID | None) -> AcquisitionItem:
    explores = row.actions is not None
    return AcquisitionItem.model_validate(
        {
            "rank": row.rank,
            "trajectory": row.trajectory_id,
            "start": row.start,
            "length": project.segment_length,
            "score": row.score,
            "confidence": row.confidence,
            "labeled": row.answer is not None if explores else label is not None,
            "actions": row.actions,
        }
    )
