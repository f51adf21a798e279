"""Projects: one environment, one model family, one labeling policy."""

from typing import Annotated, Literal
from uuid import UUID

from pydantic import Field, model_validator

from api_schemas.base import AS_JSON, Natural, Number, Positive, Schema, Seed, Timestamp
from api_schemas.environments import Environment, Spaces, bounded_grid, takes_grid, takes_robot
from api_schemas.strategies import DEFAULT_BATCH_RULE, DEFAULT_STRATEGY, BatchRuleName, StrategyName

Family = Literal["grid", "robot"]
Preset = Literal["small", "paper"]
DEFAULT_PRESET: Preset = "small"
Steps = Annotated[int, Field(ge=1, le=1_000_000), AS_JSON]


class LabelingPolicy(Schema):
    """What may be changed while a project lives.

    round_labels: a round starts by itself after this many new pool labels; 0 turns that off.
    label_budget: pool labels that the project may spend in all; None is no limit.
    batch_rule: how scored segments become a queue, every prefix of which is a batch; "top" is the plain order by score,
    of explorations each action's.
    """

    strategy: StrategyName = DEFAULT_STRATEGY
    batch_rule: BatchRuleName = DEFAULT_BATCH_RULE
    round_labels: Natural = 100
    label_budget: Positive | None = None
    lease_seconds: Number = Field(default=3600.0, gt=0, le=30 * 86400)


class ProjectCreate(Schema):
    """Segments are windows of `segment_length` transitions, `stride` apart, so they never overlap."""

    name: str = Field(min_length=1, max_length=80, pattern=r"^[^\s/\x00-\x1f](?:[^/\x00-\x1f]*[^\s/\x00-\x1f])?$")
    environment: Environment
    family: Family | None = Field(default=None, description="default: the one that takes the spaces, if any does")
    preset: Preset | None = Field(
        default=None, description=f"size of the robot family's networks and of their training; default {DEFAULT_PRESET}"
    )
    segment_length: Steps = 1
    stride: Steps | None = Field(default=None, description="default: segment_length")
    held_out_fraction: Number = Field(default=0.1, ge=0, lt=1)
    seed: Seed = 0
    policy: LabelingPolicy = LabelingPolicy()

    @model_validator(mode="after")
    def _segments_do_not_overlap(self) -> "ProjectCreate":
        if self.stride is not None and self.stride < self.segment_length:
            raise ValueError(f"stride: {self.stride} is less than segment_length {self.segment_length}")
        return self

    @model_validator(mode="after")
    def _family_takes_the_spaces(self) -> "ProjectCreate":
        if self.family is not None and self.resolved_family() != self.family:
            raise ValueError(f"family: {self.family!r} does not take these spaces")
        if self.preset is not None and self.resolved_family() != "robot":
            raise ValueError(f"preset: {self.preset!r} is for the robot family, which does not take these spaces")
        return self

    def resolved_spaces(self) -> Spaces:
        """The spaces, with the largest values that the family knows where it has a say."""
        spaces = self.environment.resolved_spaces()
        return bounded_grid(spaces) if self.resolved_family() == "grid" else spaces

    def resolved_family(self) -> Family | None:
        """The model family that takes the spaces; without one a project holds data and labels but trains nothing."""
        spaces = self.environment.resolved_spaces()
        if takes_grid(spaces):
            return "grid"
        return "robot" if takes_robot(spaces) else None

    def resolved_preset(self) -> Preset | None:
        """The preset of the family; None where it has but one."""
        return (self.preset or DEFAULT_PRESET) if self.resolved_family() == "robot" else None


class ProjectPatch(Schema):
    """Fields that are left out stay as they are."""

    strategy: StrategyName | None = None
    batch_rule: BatchRuleName | None = None
    round_labels: Natural | None = None
    label_budget: Positive | None = None
    lease_seconds: Number | None = Field(default=None, gt=0, le=30 * 86400)


class Budget(Schema):
    """Pool labels: `spent` are accepted, `reserved` are under a live lease. `total` None is no limit."""

    total: int | None
    spent: int
    reserved: int
    remaining: int | None


class PoolCounts(Schema):
    """Trajectories and segments by split. pool_segments = unlabeled + leased + labeled."""

    pool_trajectories: int
    pool_segments: int
    unlabeled: int
    leased: int
    labeled: int
    held_out_trajectories: int
    held_out_segments: int
    held_out_labeled: int


class Project(Schema):
    """A project as it stands."""

    id: UUID
    name: str
    environment: Environment
    family: Family | None
    preset: Preset | None = None
    segment_length: int
    stride: int
    held_out_fraction: float
    seed: int
    policy: LabelingPolicy
    counts: PoolCounts
    budget: Budget
    label_watermark: int
    current_round: UUID | None
    created_at: Timestamp
