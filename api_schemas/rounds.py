"""Rounds: one retraining on all labels up to a watermark, its models and its model error."""

from typing import Literal
from uuid import UUID

from api_schemas.base import Schema, Timestamp

RoundStatus = Literal["queued", "training", "scoring", "current", "superseded", "failed", "cancelled"]


class RoundCreate(Schema):
    """Retrain on all labels that are there now."""

    project: UUID


class ModelError(Schema):
    """Error on the project's labeled held-out segments.

    loss: next-state loss, summed nats a transition. dynamics_accuracy: share of the elements that changed that are
    predicted right. by_group: the same by action group (movement, interaction). inverse_accuracy counts an action as
    right when it is among those that explain the step. None: no such transition in the held-out set.
    """

    transitions: int
    loss: float | None
    dynamics_accuracy: float | None
    inverse_accuracy: float | None
    by_group: dict[str, "GroupError"] = {}


class GroupError(Schema):
    """Model error over the transitions of one action group."""

    transitions: int
    loss: float | None
    dynamics_accuracy: float | None
    inverse_accuracy: float | None


class Stage(Schema):
    """A step of a round whose result is stored; a resumed round starts after the last of them."""

    name: str
    seconds: float


class Round(Schema):
    """A round as it stands."""

    id: UUID
    project: UUID
    number: int
    watermark: int
    labels: int
    status: RoundStatus
    stages: list[Stage]
    models: dict[str, UUID]
    model_error: ModelError | None
    job: UUID | None
    error: str | None
    created_at: Timestamp
    finished_at: Timestamp | None


class ModelErrorPoint(Schema):
    """One point of the learning curve."""

    round: UUID
    number: int
    labels: int
    model_error: ModelError
    created_at: Timestamp


class ModelErrorCurve(Schema):
    """The learning curve of a project, oldest round first."""

    project: UUID
    points: list[ModelErrorPoint]
