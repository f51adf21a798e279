"""Counts and members of a project's splits."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import NamedTuple
from uuid import UUID

from sqlalchemy import ColumnElement, and_, bindparam, func, select
from sqlalchemy.orm import Session

from api_schemas.base import Split
from service.store.queries.inserting import insert
from service.store.tables import ClaimRow, LabelRow, MembershipRow, ProjectRow, TrajectoryRow


@dataclass(frozen=True)
class Member:
    """A trajectory of a split, as much of it as a draw needs."""

    trajectory_id: str
    segments: int


class Leased(NamedTuple):
    """What is under a live lease: segments of the two splits, explorations."""

    pool: int = 0
    held_out: int = 0
    explore: int = 0

    @property
    def reserved(self) -> int:
        """Labels of the budget that may still come."""
        return self.pool + self.explore


LEASED = (
    select(ClaimRow.purpose, func.count())
    .where(ClaimRow.project_id == bindparam("project"), ClaimRow.expires_at > bindparam("now"))
    .group_by(ClaimRow.purpose)
)


def leased(session: Session, project_id: UUID, now: datetime) -> Leased:
    """What of a project is under a live lease."""
    by_purpose: dict[str, int] = dict(iter(session.execute(LEASED, {"project": project_id, "now": now})))
    return Leased(**by_purpose)


def live_claim(now: datetime) -> ColumnElement[bool]:
    """The lease has not expired."""
    return ClaimRow.expires_at > now


def membership(session: Session, project_id: UUID, trajectory_id: str) -> MembershipRow | None:
    """The trajectory's membership in the project."""
    return session.scalar(
        select(MembershipRow).where(
            MembershipRow.project_id == project_id, MembershipRow.trajectory_id == trajectory_id
        )
    )


def memberships(
    session: Session, project_id: UUID, split: str, first: int = 0, last: int | None = None
) -> Sequence[MembershipRow]:
    """Members of a split in the order they came, by id from `first` to `last`."""
    statement = select(MembershipRow).where(
        MembershipRow.project_id == project_id, MembershipRow.split == split, MembershipRow.id >= first
    )
    if last is not None:
        statement = statement.where(MembershipRow.id <= last)
    return session.scalars(statement.order_by(MembershipRow.id)).all()


def members(
    session: Session, project_id: UUID, split: str, *, with_provenance: bool = False, last: int | None = None
) -> list[Member]:
    """Members of a split in the order they came, up to `last`, by two columns.

    with_provenance: only those with simulator states.
    """
    statement = select(MembershipRow.trajectory_id, MembershipRow.segments)
    statement = statement.where(*_members(project_id, split, with_provenance))
    if last is not None:
        statement = statement.where(MembershipRow.id <= last)
    return [Member(name, segments) for name, segments in session.execute(statement.order_by(MembershipRow.id))]


def _members(project_id: UUID, split: str, with_provenance: bool) -> list[ColumnElement[bool]]:
    kept = [MembershipRow.provenance_sha256.is_not(None)] if with_provenance else []
    return [MembershipRow.project_id == project_id, MembershipRow.split == split, *kept]


def sizes(session: Session, project_id: UUID, split: str) -> list[tuple[int, int]]:
    """(membership id, segments) of a split in the order they came."""
    statement = select(MembershipRow.id, MembershipRow.segments).where(
        MembershipRow.project_id == project_id, MembershipRow.split == split
    )
    return [(member, segments) for member, segments in session.execute(statement.order_by(MembershipRow.id))]


class Membership(NamedTuple):
    """As much of a membership as the rules of labels need."""

    split: Split
    segments: int


def memberships_of(session: Session, project_id: UUID, trajectory_ids: Sequence[str]) -> dict[str, Membership]:
    """Memberships in the project by trajectory, of those that are members."""
    found: dict[str, Membership] = {}
    columns = (MembershipRow.trajectory_id, MembershipRow.split, MembershipRow.segments)
    for i in range(0, len(trajectory_ids), 500):
        named = MembershipRow.trajectory_id.in_(trajectory_ids[i : i + 500])
        rows = session.execute(select(*columns).where(MembershipRow.project_id == project_id, named))
        found |= {name: Membership("pool" if split == "pool" else "held_out", count) for name, split, count in rows}
    return found


def newest_membership(session: Session, project_id: UUID, split: str) -> int:
    """Id of the youngest member of a split; 0 where it is empty."""
    statement = select(func.max(MembershipRow.id)).where(*_members(project_id, split, with_provenance=False))
    return session.scalar(statement) or 0


def newest_with_segments(session: Session, project_id: UUID, split: str, *, with_provenance: bool) -> int:
    """Id of the youngest member of a split from which segments are cut; with_provenance: and with simulator states."""
    statement = select(MembershipRow.id).where(
        *_members(project_id, split, with_provenance), MembershipRow.segments > 0
    )
    return session.scalar(statement.order_by(MembershipRow.id.desc()).limit(1)) or 0


def count_members(session: Session, project_id: UUID, split: str, last: int) -> int:
    """How many members a split had when this membership was the youngest."""
    statement = select(func.count()).where(
        *_members(project_id, split, with_provenance=False), MembershipRow.id <= last
    )
    return session.scalar(statement) or 0


def membership_rows(session: Session, project_id: UUID, trajectory_ids: Sequence[str]) -> dict[str, MembershipRow]:
    """Membership rows by trajectory, of those that are members."""
    found: dict[str, MembershipRow] = {}
    for i in range(0, len(trajectory_ids), 500):
        named = MembershipRow.trajectory_id.in_(trajectory_ids[i : i + 500])
        rows = session.scalars(select(MembershipRow).where(MembershipRow.project_id == project_id, named))
        found |= {row.trajectory_id: row for row in rows}
    return found


def keep_contents(session: Session, rows: Sequence[TrajectoryRow]) -> None:
    """Write rows of trajectories that may be there; another project may be writing the same ones at this moment."""
    if not rows:
        return
    columns = [column.key for column in TrajectoryRow.__table__.columns]
    values = [{column: getattr(row, column) for column in columns} for row in rows]
    session.execute(insert(session, TrajectoryRow).on_conflict_do_nothing(), values)


def projects_in_order(session: Session) -> Sequence[ProjectRow]:
    """All projects, oldest first."""
    return session.scalars(select(ProjectRow).order_by(ProjectRow.created_at)).all()


def project_named(session: Session, name: str) -> ProjectRow | None:
    """The project of that name."""
    return session.scalar(select(ProjectRow).where(ProjectRow.name == name))


def contents(session: Session, trajectory_ids: Sequence[str]) -> dict[str, TrajectoryRow]:
    """Trajectory rows by id."""
    found: dict[str, TrajectoryRow] = {}
    for i in range(0, len(trajectory_ids), 500):  # databases bound the number of parameters
        rows = session.scalars(select(TrajectoryRow).where(TrajectoryRow.id.in_(trajectory_ids[i : i + 500])))
        found |= {row.id: row for row in rows}
    return found


def taken_starts(session: Session, project_id: UUID, split: str, now: datetime) -> dict[str, set[int]]:
    """Starts by trajectory of the segments that are labeled or under a live lease."""
    labeled = select(LabelRow.trajectory_id, LabelRow.start).where(
        LabelRow.project_id == project_id, LabelRow.split == split
    )
    leased = select(ClaimRow.trajectory_id, ClaimRow.start).where(
        and_(ClaimRow.project_id == project_id, ClaimRow.purpose == split, live_claim(now))
    )
    taken: dict[str, set[int]] = {}
    for statement in (labeled, leased):
        for trajectory, start in session.execute(statement):
            taken.setdefault(trajectory, set()).add(start)
    return taken
