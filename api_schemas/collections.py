"""Collections: a behavior policy runs in a simulator and its trajectories join a project."""

from typing import Annotated
from uuid import UUID

from pydantic import Field, Strict, model_validator

from api_schemas.base import AS_JSON, Positive, Schema, Seed
from api_schemas.trajectories import SplitChoice

MOST_SHARDS = 64


class CollectionLabels(Schema):
    """Which labels a collection records; one of the three.

    per_action: of so many effective transitions of each discrete action (one that changes the observation).
    segments: of the first so many segments, where actions are boxes.
    all: of every segment of every trajectory, where actions are boxes: warm-up and validation sets.
    """

    per_action: Positive | None = None
    segments: Positive | None = None
    all: Annotated[bool, Strict()] = False

    @model_validator(mode="after")
    def _one_way(self) -> "CollectionLabels":
        if (self.per_action is not None) + (self.segments is not None) + self.all != 1:
            raise ValueError("labels: give per_action, segments or all, and one of them only")
        return self

    @property
    def number(self) -> int | None:
        """How many are asked for, by action or in all; None is no limit."""
        return self.per_action or self.segments


class CollectionCreate(Schema):
    """Collect `transitions` transitions or `trajectories` whole trajectories; with a number of `labels`, stop as soon
    as there are so many.

    behavior: one of the simulator's; null is its default, which covers good and bad: `mixture` of MiniGrid,
    `noisy_expert` of the robots. `policy:` and the id of a policy rolls that out with noise.
    shards: jobs that different workers run side by side, each with its share of transitions or trajectories and of
    labels, and a generator of its own that follows from the seed and its number.

    The behavior sees the simulator, so its actions are known while it runs: they are stored nowhere except as the
    labels that `labels` asks for.
    """

    project: UUID
    behavior: Annotated[str, Field(min_length=1, max_length=80)] | None = None
    transitions: Annotated[int, Field(ge=1, le=10_000_000), AS_JSON] | None = None
    trajectories: Annotated[int, Field(ge=1, le=1_000_000), AS_JSON] | None = None
    seed: Seed = 0
    split: SplitChoice = "auto"
    labels: CollectionLabels | None = None
    shards: Annotated[int, Field(ge=1, le=MOST_SHARDS), AS_JSON] = 1

    @model_validator(mode="after")
    def _one_extent(self) -> "CollectionCreate":
        if (self.transitions is None) == (self.trajectories is None):
            given = "neither" if self.transitions is None else f"{self.transitions} and {self.trajectories}"
            raise ValueError(f"transitions: give transitions or trajectories, and one of them only; got {given}")
        return self

    @model_validator(mode="after")
    def _every_shard_has_work(self) -> "CollectionCreate":
        counted = {"transitions": self.transitions, "trajectories": self.trajectories}
        counted["labels"] = None if self.labels is None else self.labels.number
        for name, number in counted.items():
            if number is not None and number < self.shards:
                raise ValueError(f"shards: {self.shards} of them cannot share {number} {name}")
        return self
