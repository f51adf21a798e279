"""Collections: a behavior policy runs in a simulator and its trajectories join a project."""

from typing import Annotated
from uuid import UUID

from pydantic import Field

from api_schemas.base import AS_JSON, Positive, Schema, Seed
from api_schemas.trajectories import SplitChoice


class CollectionLabels(Schema):
    """Record labels for `per_action` effective transitions of each discrete action (one that changes the observation).

    Boxes have no actions to count by: a collection for such a project asks for none.
    """

    per_action: Positive


class CollectionCreate(Schema):
    """Collect `transitions` transitions; with `labels`, stop as soon as every action has its share.

    behavior: one of the simulator's; null is its default, which covers good and bad: `mixture` of MiniGrid,
    `noisy_expert` of the robots. `policy:` and the id of a policy rolls that out with noise.

    The behavior sees the simulator, so its actions are known while it runs: they are stored nowhere except as the
    labels that `labels` asks for.
    """

    project: UUID
    behavior: Annotated[str, Field(min_length=1, max_length=80)] | None = None
    transitions: Annotated[int, Field(ge=1, le=10_000_000), AS_JSON]
    seed: Seed = 0
    split: SplitChoice = "auto"
    labels: CollectionLabels | None = None
