"""Rounds: one retraining on all labels up to a watermark, whose stages are stored as they are done."""

from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from api_schemas.jobs import TrainRound, TrainSubgoalGenerator
from api_schemas.rounds import Diagnostics, ModelError, ModelErrorCurve, ModelErrorPoint, Round, Stage
from service import events, jobs, projects
from service.errors import NoModelFamily, NothingToLearn, UnknownResource
from service.store.queries import jobs as job_queries
from service.store.queries import pool as pool_queries
from service.store.queries import rounds as queries
from service.store.queries import rows
from service.store.tables import ModelVersionRow, ProjectRow, RoundRow


def request(session: Session, project: ProjectRow, now: datetime, max_attempts: int = 3) -> RoundRow:
    """A round on all labels that are there now, and its job. Raises NothingToLearn, NoModelFamily.

    Asked for twice on the same labels it is one round; one that still waits for a worker gives way to a newer one.
    """
    if project.family is None:
        raise NoModelFamily(project.id)
    labels = project.pool_labels
    if labels == 0:
        raise NothingToLearn(project.id)
    waiting = queries.queued_rounds(session, project.id)
    for row in waiting:
        if row.watermark == project.label_watermark:
            return row
        _supersede_queued(session, row, now)
    row = RoundRow(
        project_id=project.id,
        number=queries.last_number(session, project.id) + 1,
        watermark=project.label_watermark,
        labels=labels,
        status="queued",
        stages=[],
        created_at=now,
    )
    session.add(row)
    session.flush()
    newest_member = pool_queries.newest_membership(session, project.id, "pool")
    payload = TrainRound(round=row.id, strategy=projects.policy_of(project).strategy, memberships=newest_member)
    row.job_id = jobs.enqueue(session, project.id, payload, row.id, now, max_attempts).id
    project.labels_at_round = project.pool_labels
    _request_subgoal_generator(session, project, now, max_attempts)
    events.record(session, project.id, "round.requested", {"round": str(row.id), "labels": labels}, now)
    return row


def due(project: ProjectRow) -> bool:
    """True where enough pool labels have come since the last round was requested."""
    every = projects.policy_of(project).round_labels
    return project.family is not None and every > 0 and project.pool_labels - project.labels_at_round >= every


def find(session: Session, round_id: UUID, *, lock: bool = False) -> RoundRow:
    """The round's row. Raises UnknownResource."""
    row = rows.get(session, RoundRow, round_id, lock=lock)
    if row is None:
        raise UnknownResource("round", round_id)
    return row


def begin_training(session: Session, round_id: UUID, now: datetime) -> None:
    """The round's job has started; a round that is in use already stays so."""
    _advance(session, round_id, "queued", "training", now)


def stage_done(session: Session, round_id: UUID, name: str, seconds: float) -> None:
    """Note a finished stage, in the transaction that stores its result."""
    row = find(session, round_id, lock=True)
    row.stages = [*row.stages, Stage(name=name, seconds=round(seconds, 3)).model_dump()]


def record_error(session: Session, round_id: UUID, error: ModelError, now: datetime) -> None:
    """Store the round's model error."""
    row = find(session, round_id, lock=True)
    row.model_error = error.model_dump(mode="json")
    data: dict[str, object] = {"round": str(row.id), "labels": row.labels, "loss": error.loss}
    events.record(session, row.project_id, "round.evaluated", data, now)


def record_diagnostics(session: Session, round_id: UUID, diagnostics: Diagnostics, now: datetime) -> None:
    """Store the round's diagnostics; what they warn of is an event."""
    row = find(session, round_id, lock=True)
    row.diagnostics = diagnostics.model_dump(mode="json")
    if diagnostics.warnings:
        data: dict[str, object] = {"round": str(row.id), "number": row.number, "warnings": diagnostics.warnings}
        events.record(session, row.project_id, "round.warned", data, now)


def begin_scoring(session: Session, round_id: UUID, now: datetime) -> None:
    """Training and evaluation are done."""
    _advance(session, round_id, "training", "scoring", now)


def make_current(session: Session, round_id: UUID, now: datetime) -> None:
    """The round's queue is ready: its models and queue are in use from now on. An older round never replaces it."""
    projects.find(session, find(session, round_id).project_id, lock=True)  # one round at a time becomes current
    row = find(session, round_id, lock=True)
    if row.status in ("current", "superseded", "failed", "cancelled"):
        return
    current = queries.current_round(session, row.project_id)
    if current is not None and current.number > row.number:
        row.status = "superseded"
    else:
        if current is not None:
            current.status = "superseded"
            session.flush()  # before the other: at no moment are there two
            data: dict[str, object] = {"round": str(current.id), "number": current.number}
            events.record(session, row.project_id, "round.superseded", data, now)
        row.status = "current"
    row.finished_at = now
    events.record(session, row.project_id, f"round.{row.status}", {"round": str(row.id), "number": row.number}, now)


def fail(session: Session, round_id: UUID, error: str, now: datetime) -> None:
    """The round's job gave up; a round that is in use stays in use."""
    project = projects.find(session, find(session, round_id).project_id, lock=True)  # the project always comes first
    row = find(session, round_id, lock=True)
    if row.status in ("current", "superseded", "cancelled"):
        return
    row.status, row.error, row.finished_at = "failed", error, now
    project.labels_at_round = 0  # its labels are due again: the next one that is accepted asks for a round
    events.record(session, row.project_id, "round.failed", {"round": str(row.id), "error": error}, now)


def cancel(
    session: Session, round_id: UUID, now: datetime, while_in: Sequence[str] = ("queued", "training", "scoring")
) -> None:
    """Somebody stopped the round; its labels are not due again. In any other status it stays as it is."""
    projects.find(session, find(session, round_id).project_id, lock=True)
    row = find(session, round_id, lock=True)
    if row.status not in while_in:
        return
    row.status, row.finished_at = "cancelled", now
    events.record(session, row.project_id, "round.cancelled", {"round": str(row.id), "number": row.number}, now)


def curve(session: Session, project: ProjectRow) -> ModelErrorCurve:
    """The learning curve, oldest round first."""
    points = [
        ModelErrorPoint(
            round=row.id,
            number=row.number,
            labels=row.labels,
            model_error=ModelError.model_validate(row.model_error),
            created_at=row.created_at,
        )
        for row in queries.evaluated_rounds(session, project.id)
    ]
    return ModelErrorCurve(project=project.id, points=points)


def describe(session: Session, row: RoundRow) -> Round:
    """The round as the API shows it."""
    models = {_model_name(model): model.id for model in queries.models_of(session, row.id)}
    return Round(
        id=row.id,
        project=row.project_id,
        number=row.number,
        watermark=row.watermark,
        labels=row.labels,
        status=row.status,  # type: ignore[arg-type]  # pydantic checks the literal
        stages=[Stage.model_validate(stage) for stage in row.stages],
        models=models,
        model_error=None if row.model_error is None else ModelError.model_validate(row.model_error),
        diagnostics=None if row.diagnostics is None else Diagnostics.model_validate(row.diagnostics),
        job=row.job_id,
        error=row.error,
        created_at=row.created_at,
        finished_at=row.finished_at,
    )


def _advance(session: Session, round_id: UUID, before: str, after: str, now: datetime) -> None:
    row = find(session, round_id, lock=True)
    if row.status == before:
        row.status = after
        events.record(session, row.project_id, f"round.{after}", {"round": str(row.id), "number": row.number}, now)


def _supersede_queued(session: Session, row: RoundRow, now: datetime) -> None:
    """The round's job finds it superseded and returns at once."""
    row.status, row.finished_at = "superseded", now
    events.record(session, row.project_id, "round.superseded", {"round": str(row.id), "number": row.number}, now)


def _request_subgoal_generator(session: Session, project: ProjectRow, now: datetime, max_attempts: int) -> None:
    """The generator learns from action-free data only, so it follows the pool's growth and not the labels."""
    newest = queries.newest_model(session, project.id, "subgoal_generator")
    if newest is not None and project.pool_trajectories < 2 * newest.watermark:
        return
    if job_queries.unfinished(session, project.id, "train_subgoal_generator") is None:
        newest_member = pool_queries.newest_membership(session, project.id, "pool")
        payload = TrainSubgoalGenerator(project=project.id, memberships=newest_member)
        jobs.enqueue(session, project.id, payload, project.id, now, max_attempts)


def _model_name(model: ModelVersionRow) -> str:
    return f"{model.kind}-{model.member}" if model.kind == "ensemble" else model.kind
