"""Projects and what they hold: trajectories, members of the splits, labels."""

from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from service.store.columns import Row


class ProjectRow(Row):
    """One project and its counters, which change under this row's lock only.

    `label_watermark` counts accepted labels, `token` the leases given out; the others count the members of the splits.
    """

    __tablename__ = "project"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    name: Mapped[str] = mapped_column(String(80), unique=True)
    environment: Mapped[dict[str, object]]
    spaces: Mapped[dict[str, object]]
    family: Mapped[str | None] = mapped_column(String(40))
    preset: Mapped[str | None] = mapped_column(String(40))
    segment_length: Mapped[int]
    stride: Mapped[int]
    held_out_fraction: Mapped[float]
    seed: Mapped[int]
    policy: Mapped[dict[str, object]]
    label_watermark: Mapped[int] = mapped_column(default=0)
    labels_at_round: Mapped[int] = mapped_column(default=0)  # pool_labels when the last round was requested
    pool_labels: Mapped[int] = mapped_column(default=0)
    held_out_labels: Mapped[int] = mapped_column(default=0)
    pool_trajectories: Mapped[int] = mapped_column(default=0)
    pool_segments: Mapped[int] = mapped_column(default=0)
    held_out_trajectories: Mapped[int] = mapped_column(default=0)
    held_out_segments: Mapped[int] = mapped_column(default=0)
    token: Mapped[int] = mapped_column(default=0)
    created_at: Mapped[datetime]


class TrajectoryRow(Row):
    """Content, shared by all projects that hold it. `id` names the decoded arrays, `blob_sha256` the stored bytes."""

    __tablename__ = "trajectory"
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    blob_sha256: Mapped[str] = mapped_column(String(64))
    transitions: Mapped[int]
    streams: Mapped[dict[str, object]]
    bytes: Mapped[int]
    created_at: Mapped[datetime]


class MembershipRow(Row):
    """A trajectory in a project. `segments` is how many windows the project cuts from it."""

    __tablename__ = "membership"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"))
    trajectory_id: Mapped[str] = mapped_column(ForeignKey("trajectory.id"))
    split: Mapped[str] = mapped_column(String(10))
    segments: Mapped[int]
    provenance_sha256: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[datetime]
    __table_args__ = (
        Index("uq_membership_trajectory", "project_id", "trajectory_id", unique=True),
        Index("ix_membership_split", "project_id", "split", "id"),
    )


class LabelRow(Row):
    """Actions of a segment. The natural key (project, trajectory, start) holds one label for ever."""

    __tablename__ = "label"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    project_id: Mapped[UUID] = mapped_column(ForeignKey("project.id"))
    trajectory_id: Mapped[str] = mapped_column(ForeignKey("trajectory.id"))
    start: Mapped[int]
    split: Mapped[str] = mapped_column(String(10))
    actions: Mapped[list[object]]
    action_sets: Mapped[list[object] | None]
    content_sha256: Mapped[str] = mapped_column(String(64))
    residual: Mapped[float | None]
    source: Mapped[dict[str, object]]
    acquisition_id: Mapped[UUID | None]
    watermark: Mapped[int]
    created_at: Mapped[datetime]
    __table_args__ = (
        Index("uq_label_segment", "project_id", "trajectory_id", "start", unique=True),
        Index("ix_label_watermark", "project_id", "watermark"),
    )
