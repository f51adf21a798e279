"""Collections: jobs that run a behavior in the project's simulator."""

from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.environments import DEFAULT_BEHAVIORS, SIMULATOR_BEHAVIORS, DiscreteActions
from api_schemas.jobs import Collect, CollectionStarted
from api_schemas.policies import PREFIX
from service import jobs, policies, projects
from service.errors import InvalidField, NoSimulator, UnknownBehavior
from service.store.tables import JobRow, ProjectRow


def request(
    session: Session, asked: CollectionCreate, now: datetime, max_attempts: int = 3, only: UUID | None = None
) -> list[JobRow]:
    """The jobs that collect, one a shard. Raises UnknownResource, NoSimulator, UnknownBehavior, InvalidField.

    only: the one project that who asks may reach; None for all.
    """
    project = projects.find(session, asked.project)
    simulator = projects.environment_of(project).simulator
    if simulator is None:
        raise NoSimulator(project.id)
    behaviors, behavior = SIMULATOR_BEHAVIORS[simulator], asked.behavior or DEFAULT_BEHAVIORS[simulator]
    if behavior.startswith(PREFIX):
        policies.choose(session, project, behavior, only, now)
    elif behavior not in behaviors:
        raise UnknownBehavior("behavior", behavior, f"must be one of {', '.join(behaviors)}")
    if asked.labels is not None:
        _check_labels(project, asked.labels)
    chosen = asked.model_copy(update={"behavior": behavior})  # what a worker does is decided when it is asked
    work = [Collect(collection=chosen)] if asked.shards == 1 else [_shard(chosen, n) for n in range(asked.shards)]
    return [jobs.enqueue(session, project.id, each, project.id, now, max_attempts) for each in work]


def started(rows: Sequence[JobRow]) -> CollectionStarted:
    """The jobs of a collection as the API shows them."""
    return CollectionStarted(**dict(jobs.describe(rows[0])), jobs=[row.id for row in rows])


def _shard(asked: CollectionCreate, shard: int) -> Collect:
    """A shard's part of what was asked for, decided before any of them runs."""
    numbers = (("transitions", asked.transitions), ("trajectories", asked.trajectories))
    share: dict[str, object] = {name: _share(number, shard, asked.shards) for name, number in numbers}
    if asked.labels is not None:
        numbers = (("per_action", asked.labels.per_action), ("segments", asked.labels.segments))
        parts = {name: _share(number, shard, asked.shards) for name, number in numbers}
        share["labels"] = asked.labels.model_copy(update=parts)
    return Collect(collection=asked.model_copy(update={**share, "shards": 1}), shard=shard)


def _share(number: int | None, shard: int, shards: int) -> int | None:
    """Of `number` things, as even as they can be shared out."""
    return None if number is None else number // shards + (shard < number % shards)


def _check_labels(project: ProjectRow, asked: CollectionLabels) -> None:
    """Counting effective steps by action needs single steps and countable actions; of boxes whole segments are labeled,
    and of countable actions none are, as all that explain a step would have to be told."""
    actions = projects.spaces_of(project).actions
    if isinstance(actions, DiscreteActions):
        if asked.per_action is None:
            name, value = ("labels.segments", asked.segments) if asked.segments else ("labels.all", "true")
            reason = f"is for boxes, and this project's {actions.n} actions are discrete: use labels.per_action"
            raise InvalidField(name, value, reason)
        if project.segment_length != 1:
            raise InvalidField("labels.per_action", project.segment_length, "needs segments of length 1")
    elif asked.per_action is not None:
        reason = f"needs discrete actions to count by, and this project's are boxes of shape {list(actions.shape)}"
        raise InvalidField("labels.per_action", asked.per_action, reason)
