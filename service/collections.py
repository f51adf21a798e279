"""Collections: jobs that run a behavior in the project's simulator."""

from datetime import datetime

from sqlalchemy.orm import Session

from api_schemas.collections import CollectionCreate
from api_schemas.environments import SIMULATOR_BEHAVIORS, DiscreteActions
from api_schemas.jobs import Collect
from service import jobs, projects
from service.errors import InvalidField, NoSimulator, UnknownBehavior
from service.store.tables import JobRow, ProjectRow


def request(session: Session, asked: CollectionCreate, now: datetime, max_attempts: int = 3) -> JobRow:
    """The job that collects. Raises UnknownResource, NoSimulator, UnknownBehavior, InvalidField."""
    project = projects.find(session, asked.project)
    simulator = projects.environment_of(project).simulator
    if simulator is None:
        raise NoSimulator(project.id)
    behaviors = SIMULATOR_BEHAVIORS[simulator]
    if asked.behavior not in behaviors:
        raise UnknownBehavior("behavior", asked.behavior, f"must be one of {', '.join(behaviors)}")
    if asked.labels is not None:
        _check_labels(project)
    return jobs.enqueue(session, project.id, Collect(collection=asked), project.id, now, max_attempts)


def _check_labels(project: ProjectRow) -> None:
    """Counting effective steps by action needs single steps and countable actions."""
    if not isinstance(projects.spaces_of(project).actions, DiscreteActions) or project.segment_length != 1:
        raise InvalidField(
            "labels.per_action", project.segment_length, "needs discrete actions and segments of length 1"
        )
