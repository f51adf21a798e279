"""Projects: one environment, one model family, one labeling policy."""

from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from api_schemas.environments import DiscreteActions, Environment, Spaces
from api_schemas.projects import Budget, LabelingPolicy, PoolCounts, Project, ProjectCreate, ProjectPatch
from api_schemas.strategies import PRIVILEGED, TRY_EVERY_ACTION
from service import events
from service.errors import InvalidField, NameTaken, PrivilegedStrategy, UnknownResource
from service.store.queries import pool as pool_queries
from service.store.queries import rounds as round_queries
from service.store.queries import rows
from service.store.queries.pool import Leased
from service.store.tables import ProjectRow


def create(session: Session, request: ProjectCreate, now: datetime) -> ProjectRow:
    """A new project. Raises NameTaken, PrivilegedStrategy, NotForBoxes."""
    refuse_unfit("policy.strategy", request.policy.strategy, request.resolved_spaces())
    if pool_queries.project_named(session, request.name) is not None:
        raise NameTaken(request.name)
    row = ProjectRow(
        name=request.name,
        environment=request.environment.model_dump(mode="json"),
        spaces=request.resolved_spaces().model_dump(mode="json"),
        family=request.resolved_family(),
        preset=request.resolved_preset(),
        segment_length=request.segment_length,
        stride=request.stride or request.segment_length,
        held_out_fraction=request.held_out_fraction,
        seed=request.seed,
        policy=request.policy.model_dump(mode="json"),
        created_at=now,
    )
    session.add(row)
    try:
        session.flush()
    except IntegrityError as error:  # another took the name after the look above
        raise NameTaken(request.name) from error
    events.record(session, row.id, "project.created", {"name": row.name}, now)
    return row


def find(session: Session, project_id: UUID, *, lock: bool = False) -> ProjectRow:
    """The project's row, locked on demand where the database locks rows. Raises UnknownResource."""
    row = rows.get(session, ProjectRow, project_id, lock=lock)
    if row is None:
        raise UnknownResource("project", project_id)
    return row


def named(session: Session, name: str) -> ProjectRow:
    """The project of that name, or of that id. Raises UnknownResource."""
    row = pool_queries.project_named(session, name)
    if row is not None:
        return row
    try:
        return find(session, UUID(name))
    except ValueError:
        raise UnknownResource("project", name) from None


def change(session: Session, project_id: UUID, patch: ProjectPatch, now: datetime) -> ProjectRow:
    """Change the labeling policy; fields that were not sent stay. A null label_budget lifts the budget.

    Raises PrivilegedStrategy, NotForBoxes.
    """
    row = find(session, project_id, lock=True)
    if patch.strategy is not None:
        refuse_unfit("strategy", patch.strategy, spaces_of(row))
    sent = patch.model_dump(exclude_unset=True)
    changes = {name: value for name, value in sent.items() if value is not None or name == "label_budget"}
    row.policy = LabelingPolicy.model_validate(row.policy | changes).model_dump(mode="json")
    events.record(session, row.id, "project.changed", dict(changes), now)
    return row


class NotForBoxes(InvalidField):
    """This strategy does not take this project's actions."""


def refuse_unfit(field: str, strategy: str, spaces: Spaces) -> None:
    """A strategy that needs hidden actions is for benchmarks only, and one that tries every action for finite sets.

    Raises PrivilegedStrategy, NotForBoxes.
    """
    if strategy in PRIVILEGED:
        raise PrivilegedStrategy(field, strategy)
    if strategy in TRY_EVERY_ACTION and not isinstance(spaces.actions, DiscreteActions):
        raise NotForBoxes(field, strategy, "tries every action; those of this project are a box")


def policy_of(row: ProjectRow) -> LabelingPolicy:
    """The typed labeling policy."""
    return LabelingPolicy.model_validate(row.policy)


def spaces_of(row: ProjectRow) -> Spaces:
    """The typed observation and action spaces."""
    return Spaces.model_validate(row.spaces)


def environment_of(row: ProjectRow) -> Environment:
    """The typed environment."""
    return Environment.model_validate(row.environment)


@dataclass(frozen=True)
class SplitCount:
    """Trajectories and segments of one split; live leases and labels among them."""

    trajectories: int
    segments: int
    leased: int
    labeled: int

    @property
    def free(self) -> int:
        """Segments that are neither leased nor labeled."""
        return self.segments - self.leased - self.labeled


def split_count(row: ProjectRow, split: str, leased: Leased) -> SplitCount:
    """Counts of one split, from the project's counters and what is under a live lease."""
    if split == "pool":
        return SplitCount(row.pool_trajectories, row.pool_segments, leased.pool, row.pool_labels)
    return SplitCount(row.held_out_trajectories, row.held_out_segments, leased.held_out, row.held_out_labels)


def budget_of(row: ProjectRow, leased: Leased) -> Budget:
    """Labels spent on the pool, and reserved by live leases, against the budget."""
    total = policy_of(row).label_budget
    remaining = None if total is None else max(0, total - row.pool_labels - leased.reserved)
    return Budget(total=total, spent=row.pool_labels, reserved=leased.reserved, remaining=remaining)


def describe(session: Session, row: ProjectRow, now: datetime) -> Project:
    """The project as the API shows it."""
    leased = pool_queries.leased(session, row.id, now)
    pool, held_out = split_count(row, "pool", leased), split_count(row, "held_out", leased)
    current = round_queries.current_round(session, row.id)
    counts = PoolCounts(
        pool_trajectories=pool.trajectories,
        pool_segments=pool.segments,
        unlabeled=pool.free,
        leased=pool.leased,
        labeled=pool.labeled,
        held_out_trajectories=held_out.trajectories,
        held_out_segments=held_out.segments,
        held_out_labeled=held_out.labeled,
    )
    return Project(
        id=row.id,
        name=row.name,
        environment=environment_of(row),
        family=row.family,  # type: ignore[arg-type]  # pydantic checks the literal
        preset=row.preset,  # type: ignore[arg-type]  # pydantic checks the literal
        segment_length=row.segment_length,
        stride=row.stride,
        held_out_fraction=row.held_out_fraction,
        seed=row.seed,
        policy=policy_of(row),
        counts=counts,
        budget=budget_of(row, leased),
        label_watermark=row.label_watermark,
        current_round=current.id if current else None,
        created_at=row.created_at,
    )
