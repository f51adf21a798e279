"""Scorings, their queues, and claims on segments."""

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import NamedTuple
from uuid import UUID

from sqlalchemy import ColumnElement, Integer, Select, and_, bindparam, delete, func, or_, select, text, tuple_, update
from sqlalchemy.orm import Session

from service.store.queries.inserting import insert
from service.store.queries.segments import Segment, among, parts
from service.store.tables import (
    AcquisitionItemRow,
    AcquisitionRow,
    ClaimRow,
    LabelRow,
    MembershipRow,
    QueueRow,
    ScoringRow,
    ShardRow,
)

LABELED = select(LabelRow.id).where(
    LabelRow.project_id == QueueRow.project_id,
    LabelRow.trajectory_id == QueueRow.trajectory_id,
    LabelRow.start == QueueRow.start,
)
LEASED = select(ClaimRow.token).where(
    ClaimRow.project_id == QueueRow.project_id,
    ClaimRow.trajectory_id == QueueRow.trajectory_id,
    ClaimRow.start == QueueRow.start,
    ClaimRow.expires_at > bindparam("now"),
)
# Not outer joins: without statistics PostgreSQL joins them by the claims' expiry, every claim to every row.
FREE = and_(
    QueueRow.scoring_id == bindparam("scoring"),
    or_(QueueRow.leased_until.is_(None), QueueRow.leased_until <= bindparam("now")),
    ~LABELED.exists(),
    ~LEASED.exists(),
)
# Built once: to build them takes longer than to run them.
FRONT = select(QueueRow.rank, QueueRow.trajectory_id, QueueRow.start, QueueRow.score, QueueRow.confidence).where(FREE)
FRONT = FRONT.order_by(QueueRow.rank).limit(bindparam("count", type_=Integer()))
FRONT_LOCKED = FRONT.with_for_update(of=QueueRow, skip_locked=True)
STILL_FREE = select(QueueRow.rank).where(FREE, QueueRow.rank.between(bindparam("first"), bindparam("last")))


def newest_scoring(
    session: Session,
    project_id: UUID,
    strategy: str,
    round_id: UUID | None,
    status: str | None = None,
    mode: str = "pool",
) -> ScoringRow | None:
    """The youngest scoring of a strategy under a round that has not failed, or that has this status."""
    statement = _scorings(project_id, strategy, round_id, mode)
    wanted = ScoringRow.status != "failed" if status is None else ScoringRow.status == status
    return session.scalar(statement.where(wanted).limit(1))


def _scorings(project_id: UUID, strategy: str, round_id: UUID | None, mode: str = "pool") -> Select[ScoringRow]:
    """Youngest first."""
    statement = select(ScoringRow).where(
        ScoringRow.project_id == project_id,
        ScoringRow.mode == mode,
        ScoringRow.strategy == strategy,
        ScoringRow.round_id == round_id if round_id else ScoringRow.round_id.is_(None),
    )
    return statement.order_by(ScoringRow.created_at.desc())


def times_proposed(session: Session, scoring: ScoringRow) -> int:
    """How often explorations were queued for the strategy under the round, by this scoring and by those before it."""
    alike = _scorings(scoring.project_id, scoring.strategy, scoring.round_id, "explore").order_by(None)
    return session.scalar(alike.with_only_columns(func.sum(ScoringRow.selections))) or 0


def explored(session: Session, project_id: UUID, round_id: UUID | None) -> list[tuple[str, int, list[object]]]:
    """Trajectory, observation and actions of explorations that were given out under the round, or answered in any."""
    columns = (AcquisitionItemRow.trajectory_id, AcquisitionItemRow.start, AcquisitionItemRow.actions)
    statement = select(*columns).join(AcquisitionRow, AcquisitionRow.id == AcquisitionItemRow.acquisition_id)
    statement = statement.where(
        AcquisitionRow.project_id == project_id,
        AcquisitionRow.mode == "explore",
        or_(AcquisitionItemRow.answer.is_not(None), AcquisitionRow.round_id == round_id),
    )
    return [(trajectory, start, list(actions or ())) for trajectory, start, actions in session.execute(statement)]


class Queued(NamedTuple):
    """A ranked segment as it stands in a queue."""

    rank: int
    trajectory: str
    start: int
    score: float | None
    confidence: float | None


def newest_ready(
    session: Session, project_id: UUID, strategy: str, round_id: UUID | None
) -> tuple[ScoringRow, int] | None:
    """The youngest scoring that has not failed, if its queue is ready, and the id of the pool's youngest member."""
    member = select(func.max(MembershipRow.id)).where(
        MembershipRow.project_id == project_id, MembershipRow.split == "pool"
    )
    statement = _scorings(project_id, strategy, round_id).where(ScoringRow.status != "failed").limit(1)
    found = session.execute(statement.add_columns(func.coalesce(member.scalar_subquery(), 0))).first()
    return None if found is None or found[0].status != "ready" else (found[0], found[1])


def free_queue(session: Session, scoring: ScoringRow, count: int, now: datetime, *, lock: bool = False) -> list[Queued]:
    """The best ranked segments that are neither labeled nor under a live lease; expiry is checked here, by no sweep.

    lock: pass over the rows that another acquisition reads at this moment (PostgreSQL; SQLite has one writer anyway).
    """
    asked = {"scoring": scoring.id, "now": now, "count": count}
    return [Queued(*row) for row in session.execute(FRONT_LOCKED if lock else FRONT, asked)]


def still_free(session: Session, scoring: ScoringRow, rows: Sequence[Queued], now: datetime) -> set[int]:
    """Ranks of the queue between the first and the last of these rows, in order, whose segments are free now."""
    if not rows:
        return set()
    asked = {"scoring": scoring.id, "now": now, "first": rows[0].rank, "last": rows[-1].rank}
    return set(session.scalars(STILL_FREE, asked))


def explorations(session: Session, scoring: ScoringRow, count: int) -> Sequence[QueueRow]:
    """The best `count` of what a scoring proposes to execute. Each is given out once: who takes them drops them."""
    statement = select(QueueRow).where(QueueRow.scoring_id == scoring.id).order_by(QueueRow.rank).limit(count)
    return session.scalars(statement).all()


def add_items(session: Session, items: Sequence[Mapping[str, object]]) -> None:
    """Write the items of a batch, by column."""
    session.connection().execute(insert(session, AcquisitionItemRow), [dict(item) for item in items])


def take_claims(session: Session, claims: Sequence[Mapping[str, object]]) -> None:
    """Write claims, by column, over the expired ones of the same segments."""
    statement = insert(session, ClaimRow)
    taken = {name: statement.excluded[name] for name in ("acquisition_id", "purpose", "token", "expires_at")}
    statement = statement.on_conflict_do_update(index_elements=("project_id", "trajectory_id", "start"), set_=taken)
    session.connection().execute(statement, [dict(claim) for claim in claims])


class Claim(NamedTuple):
    """Whoever holds, or last held, a segment."""

    token: int
    expires_at: datetime


def claims_on(session: Session, project_id: UUID, segments: Sequence[Segment]) -> dict[Segment, Claim]:
    """Claims by segment, of those that have one."""
    found: dict[Segment, Claim] = {}
    columns = (ClaimRow.trajectory_id, ClaimRow.start, ClaimRow.token, ClaimRow.expires_at)
    for some in parts(segments):
        named = among(session, ClaimRow.trajectory_id, ClaimRow.start, some)
        rows = session.execute(select(*columns).where(ClaimRow.project_id == project_id, named))
        found |= {(trajectory, start): Claim(token, until) for trajectory, start, token, until in rows}
    return found


def drop_claims(session: Session, project_id: UUID, segments: Sequence[Segment]) -> None:
    """Nobody claims these segments any more."""
    for some in parts(segments):
        named = among(session, ClaimRow.trajectory_id, ClaimRow.start, some)
        gone = delete(ClaimRow).where(ClaimRow.project_id == project_id, named)
        session.execute(gone.execution_options(synchronize_session=False))


def newly_expired(session: Session, now: datetime, limit: int) -> Sequence[AcquisitionRow]:
    """Leases that have ended and are not noted as expired; those that somebody works on at this moment come later."""
    where = (AcquisitionRow.status == "leased", AcquisitionRow.lease_expires_at <= now)
    statement = select(AcquisitionRow).where(*where).limit(limit)
    return session.scalars(statement.with_for_update(skip_locked=True)).all()


def claims_of(session: Session, acquisition_id: UUID, token: int) -> Sequence[ClaimRow]:
    """What an acquisition still holds."""
    statement = select(ClaimRow).where(ClaimRow.acquisition_id == acquisition_id, ClaimRow.token == token)
    return session.scalars(statement).all()


def extend_claims(session: Session, acquisition_id: UUID, token: int, expires_at: datetime) -> None:
    """Move the end of all claims of an acquisition."""
    where = and_(ClaimRow.acquisition_id == acquisition_id, ClaimRow.token == token)
    session.execute(update(ClaimRow).where(where).values(expires_at=expires_at))


def items_with_labels(session: Session, acquisition_id: UUID) -> Sequence[tuple[AcquisitionItemRow, UUID | None]]:
    """The items of a batch by rank, each with the id of its segment's label in this acquisition's project, if any."""
    statement = (
        select(AcquisitionItemRow, LabelRow.id)
        .join(AcquisitionRow, AcquisitionRow.id == AcquisitionItemRow.acquisition_id)
        .outerjoin(LabelRow, _label_of_item())
        .where(AcquisitionItemRow.acquisition_id == acquisition_id)
        .order_by(AcquisitionItemRow.rank)
    )
    return [(item, label_id) for item, label_id in session.execute(statement)]


def has_open_items(session: Session, row: AcquisitionRow) -> bool:
    """True where an item of the batch has no label, an exploration no answer."""
    label = select(LabelRow.id).where(_label_of_item()).exists()
    unanswered = AcquisitionItemRow.answer.is_(None) if row.mode == "explore" else ~label
    items = select(AcquisitionItemRow.rank).join(AcquisitionRow, AcquisitionRow.id == AcquisitionItemRow.acquisition_id)
    open_one = items.where(AcquisitionItemRow.acquisition_id == row.id, unanswered).limit(1)
    return session.scalar(open_one) is not None


def _label_of_item() -> ColumnElement[bool]:
    return and_(
        LabelRow.project_id == AcquisitionRow.project_id,
        LabelRow.trajectory_id == AcquisitionItemRow.trajectory_id,
        LabelRow.start == AcquisitionItemRow.start,
    )


def drop_from_queues(session: Session, project_id: UUID, segments: Sequence[Segment]) -> None:
    """Labeled segments are in no queue. Rows that an acquisition reads at this moment stay: to wait for it could be to
    wait for ourselves, and what is labeled is passed over there anyway. What began there can still be explored."""
    for some in parts(segments):
        named = and_(among(session, QueueRow.trajectory_id, QueueRow.start, some), QueueRow.actions.is_(None))
        rows = select(QueueRow.scoring_id, QueueRow.rank).where(QueueRow.project_id == project_id, named)
        gone = tuple_(QueueRow.scoring_id, QueueRow.rank).in_(rows.with_for_update(skip_locked=True))
        session.execute(delete(QueueRow).where(gone).execution_options(synchronize_session=False))


def drop_explorations(session: Session, project_id: UUID, places: Sequence[Segment]) -> None:
    """What begins where an exploration has just been given out is offered to nobody, by no strategy."""
    for some in parts(places):
        named = and_(among(session, QueueRow.trajectory_id, QueueRow.start, some), QueueRow.actions.is_not(None))
        gone = delete(QueueRow).where(QueueRow.project_id == project_id, named)
        session.execute(gone.execution_options(synchronize_session=False))


def note_leased(session: Session, scoring_id: UUID, ranks: Sequence[int], until: datetime) -> None:
    """Note in a queue, whose rows the caller has read under a lock, that these are leased until then."""
    for i in range(0, len(ranks), 500):
        named = (QueueRow.scoring_id == scoring_id, QueueRow.rank.in_(ranks[i : i + 500]))
        session.connection().execute(update(QueueRow).where(*named).values(leased_until=until))


def pass_over(session: Session, project_id: UUID, segments: Sequence[Segment], until: datetime | None) -> None:
    """Note in the queues that the segments are leased until then, or no longer, as far as nobody reads them now."""
    for some in parts(segments):
        named = among(session, QueueRow.trajectory_id, QueueRow.start, some)
        rows = select(QueueRow.scoring_id, QueueRow.rank).where(QueueRow.project_id == project_id, named)
        noted = tuple_(QueueRow.scoring_id, QueueRow.rank).in_(rows.with_for_update(skip_locked=True))
        change = update(QueueRow).where(noted).values(leased_until=until)
        session.execute(change.execution_options(synchronize_session=False))


def replace_queue(session: Session, scoring: ScoringRow, rows: Sequence[QueueRow]) -> None:
    """The queue of a scoring becomes `rows`; queues of the same strategy's older scorings go."""
    older = select(ScoringRow.id).where(
        ScoringRow.project_id == scoring.project_id,
        ScoringRow.mode == scoring.mode,
        ScoringRow.strategy == scoring.strategy,
        ScoringRow.created_at < scoring.created_at,
    )
    session.execute(delete(QueueRow).where(or_(QueueRow.scoring_id == scoring.id, QueueRow.scoring_id.in_(older))))
    session.add_all(rows)


def note_sizes(session: Session) -> None:
    """Have PostgreSQL count the queue's rows: until it does so by itself it sorts the whole queue to find its front."""
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("ANALYZE queue"))


def shards(session: Session, scoring_id: UUID) -> Sequence[ShardRow]:
    """The shards of a scoring in order."""
    return session.scalars(select(ShardRow).where(ShardRow.scoring_id == scoring_id).order_by(ShardRow.number)).all()


def unscored_shards(session: Session, scoring_id: UUID) -> int:
    """How many shards have no scores yet."""
    where = and_(ShardRow.scoring_id == scoring_id, ShardRow.blob_sha256.is_(None))
    return session.scalar(select(func.count()).where(where)) or 0
