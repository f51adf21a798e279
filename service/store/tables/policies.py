"""Policies that collections can roll out."""

from datetime import datetime
from uuid import UUID

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from service.store.columns import Row


class PolicyRow(Row):
    """A policy in a project; its weights are the blob `sha256` of the provenance store, for they tell of actions.

    `training_id` is the job that trained it. `state_sha256`, of its newest stage only, is what training goes on from.
    """

    __tablename__ = "policy"
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"), primary_key=True)
    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    training_id: Mapped[UUID] = mapped_column(index=True)
    observations: Mapped[str] = mapped_column(String(10))
    stage: Mapped[int]
    stages: Mapped[int]
    steps: Mapped[int]
    success: Mapped[float]
    episodes: Mapped[int]
    bytes: Mapped[int]
    state_sha256: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[datetime]
    __table_args__ = (Index("ix_policy_sha256", "sha256"),)
