"""Retrainings and the networks that come of them."""

from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import ForeignKey, Index, String, text
from sqlalchemy.orm import Mapped, mapped_column

from service.store.columns import Row


class RoundRow(Row):
    """One retraining on all labels up to `watermark`. Stages and what they find are written as they are done."""

    __tablename__ = "round"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"))
    number: Mapped[int]
    watermark: Mapped[int]
    labels: Mapped[int]
    status: Mapped[str] = mapped_column(String(12))
    stages: Mapped[list[object]]
    model_error: Mapped[dict[str, object] | None]
    diagnostics: Mapped[dict[str, object] | None]
    job_id: Mapped[UUID | None]
    error: Mapped[str | None]
    created_at: Mapped[datetime]
    finished_at: Mapped[datetime | None]
    __table_args__ = (
        Index("uq_round_number", "project_id", "number", unique=True),
        Index(
            "uq_round_current",
            "project_id",
            unique=True,
            sqlite_where=text("status = 'current'"),
            postgresql_where=text("status = 'current'"),
        ),
    )


class ModelVersionRow(Row):
    """A trained network; its weights are the blob `sha256`."""

    __tablename__ = "model_version"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"), index=True)
    round_id: Mapped[UUID | None] = mapped_column(ForeignKey("round.id"))
    kind: Mapped[str] = mapped_column(String(40))
    member: Mapped[int] = mapped_column(default=0)
    family: Mapped[str] = mapped_column(String(40))
    config: Mapped[dict[str, object]]
    sha256: Mapped[str] = mapped_column(String(64))
    bytes: Mapped[int]
    watermark: Mapped[int]
    metrics: Mapped[dict[str, object]]
    parent_id: Mapped[UUID | None] = mapped_column(ForeignKey("model_version.id"))
    created_at: Mapped[datetime]
    __table_args__ = (Index("uq_model_version_stage", "round_id", "kind", "member", unique=True),)
