"""The rows. Arrays of scores, weights and observations are blobs; these tables grow with labels and trajectories."""

from service.store.tables.access import EventEpochRow, EventRow, IdempotencyRow, KeyRow
from service.store.tables.acquisitions import AcquisitionItemRow, AcquisitionRow, ClaimRow
from service.store.tables.jobs import JobRow, WorkerRow
from service.store.tables.policies import PolicyRow
from service.store.tables.pools import LabelRow, MembershipRow, ProjectRow, TrajectoryRow
from service.store.tables.rounds import ModelVersionRow, RoundRow
from service.store.tables.scorings import QueueRow, ScoringRow, ShardRow

__all__ = [
    "AcquisitionItemRow",
    "AcquisitionRow",
    "ClaimRow",
    "EventEpochRow",
    "EventRow",
    "IdempotencyRow",
    "JobRow",
    "KeyRow",
    "LabelRow",
    "MembershipRow",
    "ModelVersionRow",
    "PolicyRow",
    "ProjectRow",
    "QueueRow",
    "RoundRow",
    "ScoringRow",
    "ShardRow",
    "TrajectoryRow",
    "WorkerRow",
]
