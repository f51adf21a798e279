"""Trajectories: sequences of observations with no actions, immutable, named by their content."""

from typing import Literal
from uuid import UUID

from api_schemas.base import Schema, Split, Timestamp, TrajectoryId
from api_schemas.environments import Stream

SplitChoice = Literal["auto", "pool", "held_out"]


class Trajectory(Schema):
    """`transitions` observations follow the first one; `segments` is how many windows the project cuts from it."""

    id: TrajectoryId
    project: UUID
    split: Split
    transitions: int
    segments: int
    labeled: int
    streams: dict[str, Stream]
    bytes: int
    has_provenance: bool
    created_at: Timestamp


class TrajectoryReceipt(Schema):
    """What became of one uploaded file."""

    id: TrajectoryId
    source: str
    status: Literal["created", "duplicate"]
    split: Split
    transitions: int


class TrajectoriesAdded(Schema):
    """One receipt a file, in the order of the upload."""

    items: list[TrajectoryReceipt]
