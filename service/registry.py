"""The model registry: one row a trained network, its weights a blob by hash."""

from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy.orm import Session

from api_schemas.models import ModelVersion
from service import events
from service.errors import UnknownResource
from service.store.queries import rounds as queries
from service.store.tables import ModelVersionRow

OF_ROWS = ("project", "round", "parent")  # fields whose columns say that they are ids


@dataclass(frozen=True)
class TrainedModel:
    """A network whose weights are stored as the blob `sha256`, ready to be registered."""

    kind: str
    member: int
    family: str
    config: dict[str, object]
    sha256: str
    bytes: int
    metrics: dict[str, float]
    parent: UUID | None = None


def register(
    session: Session, project_id: UUID, round_id: UUID | None, model: TrainedModel, watermark: int, now: datetime
) -> ModelVersionRow:
    """A new model version. `watermark`: the labels it saw; for a subgoal generator, how many pool trajectories."""
    row = ModelVersionRow(
        project_id=project_id,
        round_id=round_id,
        kind=model.kind,
        member=model.member,
        family=model.family,
        config=model.config,
        sha256=model.sha256,
        bytes=model.bytes,
        watermark=watermark,
        metrics=dict(model.metrics),
        parent_id=model.parent,
        created_at=now,
    )
    session.add(row)
    session.flush()
    events.record(session, project_id, "model.registered", {"model": str(row.id), "kind": model.kind}, now)
    return row


def trained(row: ModelVersionRow) -> TrainedModel:
    """What was registered, to be registered for another round as well."""
    fields = (row.kind, row.member, row.family, dict(row.config), row.sha256, row.bytes)
    return TrainedModel(
        *fields, metrics={name: float(str(value)) for name, value in row.metrics.items()}, parent=row.parent_id
    )


def find(session: Session, model_id: UUID) -> ModelVersionRow:
    """The model version's row. Raises UnknownResource."""
    row = session.get(ModelVersionRow, model_id)
    if row is None:
        raise UnknownResource("model", model_id)
    return row


def of_round(session: Session, round_id: UUID, kind: str) -> list[ModelVersionRow]:
    """The networks of one kind that a round has trained so far; several only for an ensemble."""
    return [row for row in queries.models_of(session, round_id) if row.kind == kind]


def describe(row: ModelVersionRow) -> ModelVersion:
    """The model version as the API shows it."""
    fields = {name: getattr(row, name) for name in ModelVersion.model_fields if name not in OF_ROWS}
    return ModelVersion(project=row.project_id, round=row.round_id, parent=row.parent_id, **fields)
