"""Jobs: names, payloads and states. The database is the truth about them; a carrier brings an id to a worker."""

from typing import Annotated, Literal
from uuid import UUID

from pydantic import Field

from api_schemas.base import Schema, Timestamp
from api_schemas.collections import CollectionCreate
from api_schemas.policies import PolicyCreate
from api_schemas.strategies import StrategyName

RUN_JOB = "asim.run_job"  # the one Celery task; its argument is a job id

Queue = Literal["train", "score", "label", "default"]
JobState = Literal["queued", "running", "done", "failed", "cancelled"]


class Collect(Schema):
    """Run a behavior in the project's simulator and add its trajectories.

    collection: what this job does: of a shard, its share. shard: its number; None, as in older jobs, is a collection in
    one piece.
    """

    kind: Literal["collect"] = "collect"
    collection: CollectionCreate
    shard: int | None = None


class TrainPolicy(Schema):
    """Train a policy on an expert's demonstrations and keep its stages; states and actions are at hand here only."""

    kind: Literal["train_policy"] = "train_policy"
    policy: PolicyCreate


class TrainRound(Schema):
    """Train the networks of a round that `strategy` needs, evaluate, then ask for the scoring of `strategy`.

    What the round has already is not trained again, so the same job adds a second strategy's networks to a round.
    memberships: networks that learn from action-free data too read the pool's members up to this id; None: all of them.
    """

    kind: Literal["train_round"] = "train_round"
    round: UUID
    strategy: StrategyName
    memberships: int | None = None


class TrainSubgoalGenerator(Schema):
    """Train the project's subgoal generator on action-free observations; gives way to waiting work.

    memberships: the pool's members up to this id are trained on; None, as in older jobs, is all of them.
    """

    kind: Literal["train_subgoal_generator"] = "train_subgoal_generator"
    project: UUID
    memberships: int | None = None


class ScoreShard(Schema):
    """Score one shard of the pool."""

    kind: Literal["score_shard"] = "score_shard"
    scoring: UUID
    shard: int


class MergeScores(Schema):
    """Merge all shards of a scoring and select the ranked queue from them."""

    kind: Literal["merge_scores"] = "merge_scores"
    scoring: UUID


class SelectQueue(Schema):
    """Select a drained queue again from the stored scores, without rescoring."""

    kind: Literal["select_queue"] = "select_queue"
    scoring: UUID
    length: int


class ProposeExplorations(Schema):
    """Choose states of the pool and actions to execute there, by a strategy under its round's models.

    length: about how many of them are kept ready.
    """

    kind: Literal["propose_explorations"] = "propose_explorations"
    scoring: UUID
    length: int


class Canary(Schema):
    """Do nothing: that it was done shows that `queue` is served. It belongs to no project."""

    kind: Literal["canary"] = "canary"
    queue: Queue


JobPayload = Annotated[
    Collect
    | TrainPolicy
    | TrainRound
    | TrainSubgoalGenerator
    | ScoreShard
    | MergeScores
    | SelectQueue
    | ProposeExplorations
    | Canary,
    Field(discriminator="kind"),
]

QUEUES: dict[str, Queue] = {  # a canary names its own
    "collect": "label",
    "train_policy": "label",
    "train_round": "train",
    "train_subgoal_generator": "train",
    "score_shard": "score",
    "merge_scores": "score",
    "select_queue": "score",
    "propose_explorations": "score",
}
PRIORITIES: dict[str, int] = {  # others 0; higher goes first
    "canary": 100,
    "score_shard": 10,  # a queue that somebody waits for comes before the next training
    "merge_scores": 10,
    "select_queue": 10,
    "propose_explorations": 10,
    "train_subgoal_generator": -10,
}


class Job(Schema):
    """A job as it stands. `progress` runs from 0 to 1; `error` says why it failed."""

    id: UUID
    project: UUID | None  # None for a canary
    kind: str
    queue: Queue
    state: JobState
    attempts: int
    max_attempts: int
    progress: float
    message: str
    result: dict[str, object]
    error: str | None
    created_at: Timestamp
    started_at: Timestamp | None
    heartbeat_at: Timestamp | None
    finished_at: Timestamp | None


class CollectionStarted(Job):
    """The job of a collection, of one in shards the first shard's. `jobs` names those of all shards, this one first."""

    jobs: list[UUID]
