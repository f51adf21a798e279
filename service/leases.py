"""Leases: who may answer an acquisition, and until when."""

from datetime import datetime, timedelta
from uuid import UUID

from sqlalchemy.orm import Session

from service import events, projects
from service.clock import Clock
from service.errors import ServiceError, UnknownResource
from service.store.queries import acquisitions as queries
from service.store.queries import pool as pool_queries
from service.store.queries import rows
from service.store.tables import AcquisitionRow, ProjectRow

OPEN = ("leased", "expired")  # an expired lease may still be extended or answered while nobody has taken its segments
SWEPT = 200  # expired leases noted at a time


class BudgetExhausted(ServiceError):
    """The project's label budget does not cover this."""

    status_code = 409

    def __init__(self, asked: int, remaining: int, total: int) -> None:
        super().__init__(f"count: asked for {asked} segments, {remaining} of the budget of {total} labels remain")


class InvalidLeaseToken(ServiceError):
    """The token is not the one that this acquisition was given."""

    status_code = 403

    def __init__(self, acquisition: UUID, token: int | None) -> None:
        given = "no token was sent" if token is None else f"{token} is not it"
        super().__init__(f"token: acquisition {acquisition} needs the token of its lease; {given}")


class LeaseLost(ServiceError):
    """The lease has ended and cannot be used any more."""

    status_code = 410

    def __init__(self, acquisition: UUID, reason: str) -> None:
        super().__init__(f"acquisition {acquisition}: {reason}")


class SegmentLeased(ServiceError):
    """Somebody else holds the segment."""

    status_code = 423

    def __init__(self, trajectory: str, start: int, until: datetime) -> None:
        super().__init__(f"segment {trajectory}:{start} is leased to another labeler until {until.isoformat()}")


def find(session: Session, acquisition_id: UUID) -> AcquisitionRow:
    """The acquisition's row. Raises UnknownResource."""
    row = session.get(AcquisitionRow, acquisition_id)
    if row is None:
        raise UnknownResource("acquisition", acquisition_id)
    return row


def extend(session: Session, acquisition_id: UUID, token: int, seconds: float | None, clock: Clock) -> AcquisitionRow:
    """Move the lease's end. What another has claimed meanwhile stays theirs.

    A lease that has expired reserved nothing meanwhile, so it needs room in the budget again.
    Raises InvalidLeaseToken, LeaseLost, BudgetExhausted.
    """
    row, project, now = _held(session, acquisition_id, token, clock)
    held = queries.claims_of(session, row.id, token)
    if not held:
        raise LeaseLost(row.id, "its segments are labeled or held by others by now")
    revived = sum(claim.expires_at <= now and claim.purpose != "held_out" for claim in held)
    policy = projects.policy_of(project)
    row.status, row.lease_expires_at = "leased", now + timedelta(seconds=seconds or policy.lease_seconds)
    queries.extend_claims(session, row.id, token, row.lease_expires_at)
    segments = [(claim.trajectory_id, claim.start) for claim in held]
    queries.pass_over(session, row.project_id, segments, row.lease_expires_at)  # its end may be an earlier one now
    if revived:
        check_budget(session, project, revived, now)
    events.record(session, row.project_id, "lease.extended", {"acquisition": str(row.id), "items": len(held)}, now)
    return row


def release(session: Session, acquisition_id: UUID, token: int, clock: Clock) -> AcquisitionRow:
    """Give the unlabeled segments back to the pool. Raises InvalidLeaseToken, LeaseLost."""
    row, _, now = _held(session, acquisition_id, token, clock)
    held = queries.claims_of(session, row.id, token)
    for claim in held:
        session.delete(claim)
    queries.pass_over(session, row.project_id, [(claim.trajectory_id, claim.start) for claim in held], None)
    row.status = "released"
    events.record(session, row.project_id, "lease.released", {"acquisition": str(row.id), "items": len(held)}, now)
    return row


def close_if_labeled(session: Session, row: AcquisitionRow, now: datetime) -> None:
    """An acquisition whose items are all labeled is labeled."""
    session.flush()
    if row.status in OPEN and not queries.has_open_items(session, row):
        row.status = "labeled"
        events.record(session, row.project_id, "acquisition.labeled", {"acquisition": str(row.id)}, now)


def note_expired(session: Session, now: datetime) -> None:
    """Say of leases that have ended that they have. Nothing depends on it: every rule compares the times itself."""
    for row in queries.newly_expired(session, now, SWEPT):
        row.status = "expired"
        data: dict[str, object] = {"acquisition": str(row.id), "expired_at": row.lease_expires_at.isoformat()}
        events.record(session, row.project_id, "lease.expired", data, now)


def check_budget(session: Session, project: ProjectRow, added: int, now: datetime) -> None:
    """Raises BudgetExhausted where `added` labels or reservations, in this transaction, went over the budget."""
    total = projects.policy_of(project).label_budget
    if total is None:
        return
    session.flush()
    used = project.pool_labels + pool_queries.leased(session, project.id, now).reserved
    if used > total:
        raise BudgetExhausted(added, max(0, total - (used - added)), total)


def exploration_name(acquisition_id: UUID) -> str:
    """What stands for the trajectory in the claim of an explore item; its start is the item's rank."""
    return f"explore:{acquisition_id.hex}"


def _held(
    session: Session, acquisition_id: UUID, token: int, clock: Clock
) -> tuple[AcquisitionRow, ProjectRow, datetime]:
    """The acquisition, its project, and what time it is now that both are locked: waiting for a lock takes time.

    The acquisition is locked too, after the project: the sweep of expired leases locks nothing else.

    Raises UnknownResource, InvalidLeaseToken, LeaseLost.
    """
    project = projects.find(session, find(session, acquisition_id).project_id, lock=True)
    row = rows.get(session, AcquisitionRow, acquisition_id, lock=True)
    if row is None:
        raise UnknownResource("acquisition", acquisition_id)
    if token != row.token:
        raise InvalidLeaseToken(row.id, token)
    if row.status not in OPEN:
        raise LeaseLost(row.id, f"it is {row.status}")
    return row, project, clock()
