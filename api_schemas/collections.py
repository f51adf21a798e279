"""Collections: a behavior policy runs in a simulator and its trajectories join a project."""

from uuid import UUID

from pydantic import Field

from api_schemas.base import Integer, Schema
from api_schemas.trajectories import SplitChoice


class CollectionLabels(Schema):
    """Record labels for `per_action` effective transitions of each action (one that changes the observation)."""

    per_action: Integer = Field(ge=1)


class CollectionCreate(Schema):
    """Collect `transitions` transitions; with `labels`, stop as soon as every action has its share.

    The behavior sees the simulator, so its actions are known while it runs: they are stored nowhere except as the
    labels that `labels` asks for.
    """

    project: UUID
    behavior: str = Field(default="mixture", min_length=1, max_length=80)
    transitions: Integer = Field(ge=1, le=10_000_000)
    seed: Integer = Field(default=0, ge=0, lt=2**31)
    split: SplitChoice = "auto"
    labels: CollectionLabels | None = None
