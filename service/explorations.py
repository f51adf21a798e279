"""Explorations: items of an acquisition that are answered by a new trajectory, born labeled."""

from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from service import events, leases
from service.errors import InvalidField
from service.leases import LeaseLost
from service.store.queries import acquisitions as queries
from service.store.tables import AcquisitionItemRow, AcquisitionRow, ProjectRow


def answer(
    session: Session,
    project: ProjectRow,
    acquisition: AcquisitionRow | None,
    rank: int,
    trajectory: str,
    position: int,
    now: datetime,
) -> bool:
    """Note the trajectory that came of an item, which is then answered for good; the same one again changes nothing.

    Returns whether a live lease had reserved a label for it.
    Raises InvalidField where there is no such item, LeaseLost where it is answered by another or was given back.
    """
    name = f"trajectories[{position}].rank"
    if acquisition is None:
        raise InvalidField(name, rank, "needs the acquisition that it is an item of")
    item = session.get(AcquisitionItemRow, (acquisition.id, rank))
    if item is None or item.actions is None:
        raise InvalidField(name, rank, f"is no exploration of acquisition {acquisition.id}")
    if item.answer == trajectory:
        return False
    place = (leases.exploration_name(acquisition.id), rank)
    claim = queries.claims_on(session, project.id, [place]).get(place)
    if claim is None:
        raise LeaseLost(acquisition.id, _why(acquisition.id, item))
    item.answer = trajectory
    queries.drop_claims(session, project.id, [place])
    events.record(session, project.id, "exploration.answered", {"acquisition": str(acquisition.id), "rank": rank}, now)
    return claim.expires_at > now


def _why(acquisition: UUID, item: AcquisitionItemRow) -> str:
    return f"item {item.rank} is answered by {item.answer}" if item.answer else f"item {item.rank} was given back"
