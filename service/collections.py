"""Collections: jobs that run a behavior in the project's simulator."""

from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.environments import DEFAULT_BEHAVIORS, SIMULATOR_BEHAVIORS, DiscreteActions
from api_schemas.jobs import Collect
from api_schemas.policies import PREFIX
from service import jobs, policies, projects
from service.errors import InvalidField, NoSimulator, UnknownBehavior
from service.store.tables import JobRow, ProjectRow


def request(
    session: Session, asked: CollectionCreate, now: datetime, max_attempts: int = 3, only: UUID | None = None
) -> JobRow:
    """The job that collects. Raises UnknownResource, NoSimulator, UnknownBehavior, InvalidField.

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
    return jobs.enqueue(session, project.id, Collect(collection=chosen), project.id, now, max_attempts)


def _check_labels(project: ProjectRow, asked: CollectionLabels) -> None:
    """Counting effective steps by action needs single steps and countable actions."""
    actions = projects.spaces_of(project).actions
    if not isinstance(actions, DiscreteActions):
        reason = f"needs discrete actions to count by, and this project's are boxes of shape {list(actions.shape)}"
        raise InvalidField("labels.per_action", asked.per_action, reason)
    if project.segment_length != 1:
        raise InvalidField("labels.per_action", project.segment_length, "needs segments of length 1")
