"""Acquisitions: batches of segments given out under a lease."""

from typing import Annotated, Literal
from uuid import UUID

from pydantic import Field, model_validator

from api_schemas.base import AS_JSON, Integer, Number, Schema, Timestamp, TrajectoryId
from api_schemas.labels import Action
from api_schemas.projects import Budget
from api_schemas.strategies import StrategyName

Mode = Literal["pool", "explore"]
Purpose = Literal["pool", "held_out"]
AcquisitionStatus = Literal["leased", "labeled", "expired", "released"]


class AcquireRequest(Schema):
    """`strategy` and `lease_seconds` default to the project's. `held_out` draws uniformly from the held-out split.

    mode: `pool` gives segments to label. `explore` gives states to start from and actions to execute there; what is
    observed comes back as a new trajectory, born labeled.
    """

    project: UUID
    count: Annotated[int, Field(ge=1, le=10_000), AS_JSON]
    mode: Mode = "pool"
    strategy: str | None = None
    purpose: Purpose = "pool"
    lease_seconds: Number | None = Field(default=None, gt=0, le=30 * 86400)
    labeler: str = Field(default="", max_length=200, description="a name for who will answer; shown, never checked")

    @model_validator(mode="after")
    def _exploration_trains(self) -> "AcquireRequest":
        if self.mode == "explore" and self.purpose == "held_out":
            raise ValueError("purpose: 'held_out' cannot be explored: what an exploration finds is trained on")
        return self


class AcquisitionItem(Schema):
    """A segment to label: `length` actions from observation `start` on.

    confidence: how sure the inverse model was of the actions that it inferred, the product over the steps; None where
    the strategy infers none. In explore mode, `actions` to execute from observation `start`; the trajectory that comes
    of it is the answer.
    """

    rank: int
    trajectory: TrajectoryId
    start: int
    length: int
    score: float | None
    confidence: float | None = None
    labeled: bool
    actions: list[Action] | None = None


class Acquisition(Schema):
    """One batch. `token` is given to the one who acquired it and must come back with the labels.

    strategy: the one that ranked the batch; `requested_strategy` differs from it at a cold start, before any round, and
    in explore mode where that one cannot propose what to execute.
    reason: why the batch holds fewer items than were asked for; None where it holds them all.
    """

    id: UUID
    project: UUID
    mode: Mode
    purpose: Purpose
    strategy: StrategyName
    requested_strategy: StrategyName
    round: UUID | None
    status: AcquisitionStatus
    reason: str | None
    labeler: str
    token: int | None
    lease_expires_at: Timestamp
    created_at: Timestamp
    items: list[AcquisitionItem]
    budget: Budget


class AcquisitionPending(Schema):
    """No ranked queue yet: poll the job, then ask again."""

    detail: str
    job: UUID


class ExtendRequest(Schema):
    """Move the lease's end to `lease_seconds` from now."""

    token: Integer
    lease_seconds: Number | None = Field(default=None, gt=0, le=30 * 86400)


class ReleaseRequest(Schema):
    """Give back the segments that are not labeled yet."""

    token: Integer
