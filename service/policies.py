"""Policies: their training as a job, the stages that it keeps, and which of them a project can roll out."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from api_schemas.environments import DiscreteActions, takes_images
from api_schemas.jobs import TrainPolicy
from api_schemas.policies import PREFIX, Policy, PolicyCreate
from service import events, jobs, projects
from service.errors import InvalidField, NoSimulator, ServiceError, UnknownBehavior, UnknownResource
from service.store.queries import policies as queries
from service.store.tables import JobRow, PolicyRow, ProjectRow


class PoliciesOutOfReach(ServiceError):
    """The store of policies' weights is not in reach of this process."""

    status_code = 404

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}: weights of policies are in the provenance store, which is not in reach here")


@dataclass(frozen=True)
class Stage:
    """A policy at a stage of its training, its weights and the training's state stored; the last needs no state."""

    sha256: str
    bytes: int
    state_sha256: str | None
    number: int
    steps: int
    success: float
    episodes: int


def request(session: Session, asked: PolicyCreate, now: datetime, max_attempts: int = 3) -> JobRow:
    """The job that trains. Raises UnknownResource, NoSimulator, InvalidField."""
    project = projects.find(session, asked.project)
    spaces = projects.spaces_of(project)
    if projects.environment_of(project).simulator is None:
        raise NoSimulator(project.id)
    if isinstance(spaces.actions, DiscreteActions):
        raise InvalidField("project", project.id, f"needs actions in a box, this one's are {spaces.actions.n} discrete")
    _check_form("observations", asked.observations, project, asked.observations)
    return jobs.enqueue(session, project.id, TrainPolicy(policy=asked), project.id, now, max_attempts)


def keep(session: Session, training: UUID, asked: PolicyCreate, stage: Stage, now: datetime) -> str | None:
    """A row for the stage, in place of one with the same weights; only one of a training has a state.

    training: the job. Returns the hash of the state that is now of no use, if there was one.
    """
    left = release_state(session, asked.project, training)
    row = PolicyRow(
        project_id=asked.project,
        sha256=stage.sha256,
        training_id=training,
        observations=asked.observations,
        stage=stage.number,
        stages=asked.stages,
        steps=stage.steps,
        success=stage.success,
        episodes=stage.episodes,
        bytes=stage.bytes,
        state_sha256=stage.state_sha256,
        created_at=now,
    )
    session.merge(row)
    told: dict[str, object] = {"policy": stage.sha256, "stage": stage.number, "success": stage.success}
    events.record(session, asked.project, "policy.kept", told, now)
    return left


def release_state(session: Session, project_id: UUID, training: UUID) -> str | None:
    """Nothing goes on from the training's state any more, be it over or further; its hash, if there was one."""
    kept = with_state(queries.of_training(session, project_id, training))
    if kept is None:
        return None
    left, kept.state_sha256 = kept.state_sha256, None
    return left


def with_state(rows: Sequence[PolicyRow]) -> PolicyRow | None:
    """The stage that training goes on from."""
    return next((row for row in rows if row.state_sha256 is not None), None)


def find(session: Session, project_id: UUID, sha256: str) -> PolicyRow:
    """The project's policy of that id. Raises UnknownResource."""
    row = session.get(PolicyRow, (project_id, sha256))
    if row is None:
        raise UnknownResource("policy", sha256)
    return row


def choose(session: Session, project: ProjectRow, behavior: str, only: UUID | None, now: datetime) -> None:
    """Make the policy that a collection's behavior names one of the project's.

    It may be another project's of the same task; only: the one project whose policies are known to who asks, None for
    all. Raises UnknownBehavior, InvalidField.
    """
    sha256 = behavior.removeprefix(PREFIX)
    if session.get(PolicyRow, (project.id, sha256)) is not None:
        return
    row = queries.of_any_project(session, sha256) if only is None else None
    if row is None:
        raise UnknownBehavior("behavior", behavior, "names a policy that there is not; GET /policies lists them")
    theirs, ours = (_task(each) for each in (projects.find(session, row.project_id), project))
    if theirs != ours:
        raise InvalidField("behavior", behavior, f"is a policy of {theirs}, and this project is of {ours}")
    _check_form("behavior", behavior, project, row.observations)
    queries.copy(session, row, project.id, now)


def describe(row: PolicyRow) -> Policy:
    """The policy as the API shows it."""
    fields = {name: getattr(row, name) for name in Policy.model_fields if name not in ("id", "project", "training")}
    return Policy(id=row.sha256, project=row.project_id, training=row.training_id, **fields)


def _check_form(field: str, value: str, project: ProjectRow, form: str) -> None:
    if form == "images" and not takes_images(projects.spaces_of(project)):
        raise InvalidField(field, value, "acts by images, and this project has no cameras")


def _task(project: ProjectRow) -> str:
    environment = projects.environment_of(project)
    return f"{environment.task()} of {environment.simulator}"
