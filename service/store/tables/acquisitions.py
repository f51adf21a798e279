"""Batches given out, and who may label what."""

from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from service.store.columns import Row


class AcquisitionRow(Row):
    """One batch given out. Its lease lives in the claims; `token` is larger than that of any earlier lease."""

    __tablename__ = "acquisition"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"), index=True)
    mode: Mapped[str] = mapped_column(String(10), default="pool")
    purpose: Mapped[str] = mapped_column(String(10))
    strategy: Mapped[str] = mapped_column(String(40))
    requested_strategy: Mapped[str] = mapped_column(String(40))
    round_id: Mapped[UUID | None]
    status: Mapped[str] = mapped_column(String(10))
    reason: Mapped[str | None]  # why the batch is smaller than was asked for
    labeler: Mapped[str] = mapped_column(String(200))
    token: Mapped[int]
    lease_expires_at: Mapped[datetime]
    created_at: Mapped[datetime]
    __table_args__ = (Index("ix_acquisition_expiry", "status", "lease_expires_at"),)


class AcquisitionItemRow(Row):
    """A segment of a batch, for ever; who may label it now is the claim's business.

    An explore item names the observation to start from and the `actions` to execute there; `answer` is the trajectory
    that came of it.
    """

    __tablename__ = "acquisition_item"
    acquisition_id: Mapped[UUID] = mapped_column(ForeignKey("acquisition.id"), primary_key=True)
    rank: Mapped[int] = mapped_column(primary_key=True)
    trajectory_id: Mapped[str] = mapped_column(String(64))
    start: Mapped[int]
    score: Mapped[float | None]
    confidence: Mapped[float | None]
    actions: Mapped[list[object] | None]
    answer: Mapped[str | None] = mapped_column(String(64))


class ClaimRow(Row):
    """Who may label a segment: at most one row a segment, taken over when its lease has expired.

    An explore item claims no segment: its row stands under the acquisition's id and the item's rank.
    """

    __tablename__ = "claim"
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"), primary_key=True)
    trajectory_id: Mapped[str] = mapped_column(String(64), primary_key=True)
    start: Mapped[int] = mapped_column(primary_key=True)
    acquisition_id: Mapped[UUID]
    purpose: Mapped[str] = mapped_column(String(10))
    token: Mapped[int]
    expires_at: Mapped[datetime]
    __table_args__ = (Index("ix_claim_expiry", "project_id", "expires_at"), Index("ix_claim_owner", "acquisition_id"))
