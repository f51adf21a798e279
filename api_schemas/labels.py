"""Labels: the actions of a segment, accepted once and never overwritten."""

from typing import Annotated, Literal
from uuid import UUID

from pydantic import Base64Bytes, Discriminator, Field, Tag, model_validator

from api_schemas.base import Integer, Natural, Number, Schema, Split, Timestamp, TrajectoryId
from api_schemas.environments import MOST_ACTIONS, MOST_COORDINATES
from api_schemas.trajectories import SplitChoice

MOST_STEPS = 1_000_000  # of one segment or trajectory
Vector = Annotated[list[Number], Field(max_length=MOST_COORDINATES, fail_fast=True)]
Action = Annotated[
    Annotated[Integer, Tag("integer")] | Annotated[Vector, Tag("vector")],
    Discriminator(lambda value: "vector" if isinstance(value, list) else "integer"),
]
# A list ends at its first error: with one for each wrong step, a body could ask for a thousand times its size.
Steps = Annotated[list[Action], Field(min_length=1, max_length=MOST_STEPS, fail_fast=True)]
Choices = Annotated[list[Integer], Field(max_length=MOST_ACTIONS, fail_fast=True)]
ActionSets = Annotated[list[Choices], Field(max_length=MOST_STEPS, fail_fast=True)]
Starts = Annotated[list[Integer], Field(max_length=MOST_STEPS, fail_fast=True)]
MOST_SEGMENTS = 20_000  # that the labeled trajectories of one request may bring


class LabelSource(Schema):
    """Who labeled: a simulator, a robot, a person, or an import of recorded data."""

    kind: Literal["simulator", "robot", "human", "import"] = "import"
    name: str = Field(default="", max_length=200)


class LabelItem(Schema):
    """Actions of one segment.

    action_sets: where several discrete actions explain a step, all of them, one list a step, `actions` included.
    residual: how far the labeler's replay of `actions` ended from the observed observation; 0 is exact.
    """

    trajectory: TrajectoryId
    start: Natural
    actions: Steps
    action_sets: ActionSets | None = None
    residual: Number | None = Field(default=None, ge=0)


class LabeledTrajectory(Schema):
    """A whole trajectory with its actions: seed data, held-out data, a demonstration. No lease is needed.

    content: base64 of an npz file with one array a stream, time first, T + 1 observations.
    actions: T actions. starts: record only the segments that begin there, each once; default all of them. A request
        records at most 20,000 segments of trajectories.
    rank: the explore item of the request's acquisition that this trajectory answers; None where nobody asked for it.
    """

    content: Base64Bytes
    actions: Steps
    action_sets: ActionSets | None = None
    starts: Starts | None = None
    split: SplitChoice = "auto"
    rank: Natural | None = None

    @model_validator(mode="after")
    def _each_segment_once(self) -> "LabeledTrajectory":
        if self.starts is not None and len(set(self.starts)) < len(self.starts):
            raise ValueError("starts: names a segment more than once")
        return self

    @model_validator(mode="after")
    def _exploration_trains(self) -> "LabeledTrajectory":
        if self.rank is not None and self.split == "held_out":
            raise ValueError("split: 'held_out' cannot answer an exploration: what it finds is trained on")
        return self


class LabelsRequest(Schema):
    """All or nothing. `acquisition` and its `token` are needed for segments that are under a lease."""

    project: UUID
    acquisition: UUID | None = None
    token: Integer | None = None
    source: LabelSource = LabelSource()
    items: list[LabelItem] = Field(default=[], max_length=500)
    trajectories: list[LabeledTrajectory] = Field(default=[], max_length=500)


class LabelReceipt(Schema):
    """`duplicate`: the same label was there already; nothing changed."""

    trajectory: TrajectoryId
    start: int
    status: Literal["created", "duplicate"]
    split: Split


class LabelsAccepted(Schema):
    """`round` is the round that these labels started, if any."""

    receipts: list[LabelReceipt]
    created: int
    duplicates: int
    watermark: int
    round: UUID | None


class Label(Schema):
    """A stored label."""

    trajectory: TrajectoryId
    start: int
    split: Split
    actions: list[Action]
    action_sets: list[list[int]] | None
    residual: float | None
    source: LabelSource
    acquisition: UUID | None
    watermark: int
    created_at: Timestamp
