"""The model registry: one row a trained network."""

from typing import Literal
from uuid import UUID

from api_schemas.base import Schema, Timestamp

ModelKind = Literal[
    "world_model",
    "inverse_dynamics",
    "dense_inverse_dynamics",
    "masked_inverse_dynamics",
    "ensemble",
    "subgoal_generator",
]


class ModelVersion(Schema):
    """A trained network: weights by hash, its whole config, the labels it saw. `member` counts within an ensemble.

    parent: the network of an earlier round from whose weights its training began; None where it began from scratch.
    """

    id: UUID
    project: UUID
    round: UUID | None
    kind: ModelKind
    member: int
    family: str
    config: dict[str, object]
    sha256: str
    bytes: int
    watermark: int
    metrics: dict[str, float]
    parent: UUID | None = None
    created_at: Timestamp
