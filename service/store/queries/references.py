"""Which blobs the database refers to. What it does not refer to is garbage, what it refers to has to be there."""

from collections.abc import Iterator
from typing import NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import InstrumentedAttribute, Session

from service.store.tables import JobRow, MembershipRow, ModelVersionRow, PolicyRow, ShardRow, TrajectoryRow

PROVENANCE = "provenance"
COLUMNS: dict[str, InstrumentedAttribute[str] | InstrumentedAttribute[str | None]] = {
    "trajectories": TrajectoryRow.blob_sha256,
    "weights": ModelVersionRow.sha256,
    "scores": ShardRow.blob_sha256,
    "checkpoints": JobRow.checkpoint_sha256,
    PROVENANCE: MembershipRow.provenance_sha256,
    "policies": PolicyRow.sha256,
    "trainings": PolicyRow.state_sha256,
}


class Reference(NamedTuple):
    """One blob. Which store holds it follows from its kind."""

    kind: str
    sha256: str


def references(session: Session) -> Iterator[Reference]:
    """Each blob once, kind by kind."""
    for kind, column in COLUMNS.items():
        for sha256 in session.scalars(select(column).where(column.is_not(None)).distinct()):
            yield Reference(kind, str(sha256))
