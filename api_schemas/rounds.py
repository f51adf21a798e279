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

    loss: of grids the next-state loss, summed nats a transition; of robots the share of what changes that open-loop
    predictions of whole segments do not foresee, 1 where they are no better than standing still. exact_accuracy: share
    of transitions whose whole next observation is predicted right; None of robots, and in rounds from before it was
    measured. dynamics_accuracy: share of changed elements that are predicted right. by_group: the same by action group
    (movement, interaction). inverse_accuracy counts an action as right when it is among those that explain the step;
    of actions in a box, those of their numbers that are at most a tenth of the box away. open_loop: of robots, errors
    by horizon. None: no such transition in the held-out set.
    """

    transitions: int
    loss: float | None
    exact_accuracy: float | None = None
    dynamics_accuracy: float | None
    inverse_accuracy: float | None
    by_group: dict[str, "GroupError"] = {}
    open_loop: list["OpenLoopError"] = []


class GroupError(Schema):
    """Model error over the transitions of one action group."""

    transitions: int
    loss: float | None
    exact_accuracy: float | None = None
    dynamics_accuracy: float | None
    inverse_accuracy: float | None


class OpenLoopError(Schema):
    """Squared errors up to `horizon` steps after the last observation that the world model saw, by stream.

    Means over segments, steps and coordinates; of images in [0, 1], so theirs is the per-pixel error. standing_still:
    the same of a prediction that nothing moves.
    """

    horizon: int
    errors: dict[str, float]
    standing_still: dict[str, float]


class Mask(Schema):
    """How many coordinates of an observation the inverse model reads, on average, and how many there are.

    On grids these are the cells and what is carried.
    """

    kept: float
    coordinates: int


class Support(Schema):
    """How far what the inverse model reads of pool segments lies from what it reads of the nearest labeled one.

    outside: share of segments that differ from every label. Distances count the codes that differ: on grids the
    object, colour and state of each element, before and after.
    """

    outside: float
    mean: float
    percentile_95: float


class Aliasing(Schema):
    """Entropy of the inferred actions over the pool, in nats. above_ln_2: share in more doubt than between two."""

    mean: float
    percentile_95: float
    above_ln_2: float


class BackAction(Schema):
    """Share of held-out actions inferred wrong, where what the inverse model does not read is near to labels and far.

    nearest, farthest: in the first and last third of the distances. spearman: of distance and error.
    """

    steps: int
    nearest: float
    farthest: float
    spearman: float | None


class Ranking(Schema):
    """Rank correlation of the cycle's score with the true loss on held-out segments; None where nothing ranks."""

    segments: int
    spearman: float | None
    kendall: float | None


class KnownAction(Schema):
    """What is known of one action, over the steps that it alone explains.

    labels: such steps in the training set, held_out: in the held-out set. accuracy: share of those inferred right.
    """

    action: int
    name: str
    labels: int
    held_out: int
    accuracy: float | None


class Diagnostics(Schema):
    """Whether the method holds in this round: the four conditions it rests on, and whether its score ranks.

    sampled: segments of the pool that were looked at. None: nothing to look at, or no held-out labels.
    back_action_in_support: over the steps of which a label shows the inverse model the same. warnings: what is wrong,
    in sentences; empty where nothing is.
    """

    sampled: int
    mask: Mask | None
    support: Support | None
    aliasing: Aliasing | None
    back_action: BackAction | None
    back_action_in_support: BackAction | None
    ranking: Ranking | None
    ranking_by_group: dict[str, Ranking] = {}
    actions: list[KnownAction]
    warnings: list[str]


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
    diagnostics: Diagnostics | None = None
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
