"""Labels: the actions of a segment, accepted once and never overwritten."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy.orm import Session

from api_schemas.labels import (
    Action,
    Label,
    LabelItem,
    LabelReceipt,
    LabelsAccepted,
    LabelSource,
    LabelsRequest,
)
from api_schemas.trajectories import SplitChoice
from service import acquisitions, events, pool, projects, rounds
from service.actions import check_actions
from service.errors import (
    BudgetExhausted,
    InvalidField,
    InvalidLabel,
    InvalidLeaseToken,
    LabelConflict,
    LeaseLost,
    SegmentLeased,
    UnknownResource,
)
from service.pool import StoredTrajectory
from service.store.queries import acquisitions as claim_queries
from service.store.queries import labels as queries
from service.store.queries import pool as pool_queries
from service.store.tables import AcquisitionRow, LabelRow, MembershipRow, ProjectRow


@dataclass(frozen=True)
class LabeledUpload:
    """A labeled trajectory whose blob is written: all its actions, and the segments to record (None: all)."""

    stored: StoredTrajectory
    actions: Sequence[Action]
    action_sets: Sequence[list[int]] | None
    starts: Sequence[int] | None
    split: SplitChoice
    provenance_sha256: str | None = None


def accept(
    session: Session, request: LabelsRequest, uploads: Sequence[LabeledUpload], now: datetime, max_attempts: int = 5
) -> LabelsAccepted:
    """Store all labels or none, in the caller's transaction, and ask for a round when enough have come.

    uploads: the request's labeled trajectories, stored. Raises UnknownResource, InvalidLabel, InvalidLeaseToken,
    LeaseLost, SegmentLeased, LabelConflict, SplitConflict, BudgetExhausted.
    """
    project = projects.find(session, request.project, lock=True)
    acquisition = _acquisition(session, project, request)
    receipts = []
    for upload in uploads:
        pool.add(session, project, upload.stored, upload.split, now, upload.provenance_sha256)
        for item in _items(project, upload):
            receipts.append(_accept_item(session, project, item, request.source, acquisition, now))
    for item in request.items:
        receipts.append(_accept_item(session, project, item, request.source, acquisition, now))
    if acquisition is not None:
        acquisitions.close_if_labeled(session, acquisition, now)
    created = sum(receipt.status == "created" for receipt in receipts)
    _check_budget(project, created)
    if created:
        data: dict[str, object] = {"count": created, "watermark": project.label_watermark, "by": request.source.name}
        events.record(session, project.id, "labels.accepted", data, now)
    round_row = rounds.request(session, project, now, max_attempts) if created and rounds.due(project) else None
    return LabelsAccepted(
        receipts=receipts,
        created=created,
        duplicates=len(receipts) - created,
        watermark=project.label_watermark,
        round=round_row.id if round_row else None,
    )


def describe(row: LabelRow) -> Label:
    """The label as the API shows it."""
    return Label.model_validate(
        {
            "trajectory": row.trajectory_id,
            "start": row.start,
            "split": row.split,
            "actions": row.actions,
            "action_sets": row.action_sets,
            "residual": row.residual,
            "source": row.source,
            "acquisition": row.acquisition_id,
            "watermark": row.watermark,
            "created_at": row.created_at,
        }
    )


def _accept_item(
    session: Session,
    project: ProjectRow,
    item: LabelItem,
    source: LabelSource,
    acquisition: AcquisitionRow | None,
    now: datetime,
) -> LabelReceipt:
    member = _member(session, project, item)
    _check_segment(session, project, member, item)
    digest = _content_sha256(item)
    stored = queries.label_of(session, project.id, item.trajectory, item.start)
    if stored is not None:
        if stored.content_sha256 != digest:
            raise LabelConflict(item.trajectory, item.start, _shown(stored), _shown(item))
        return _receipt(item, member, "duplicate")
    _check_lease(session, project, item, acquisition, now)
    _store(session, project, member, item, digest, source, acquisition, now)
    return _receipt(item, member, "created")


def _acquisition(session: Session, project: ProjectRow, request: LabelsRequest) -> AcquisitionRow | None:
    if request.acquisition is None:
        if request.token is not None:
            raise InvalidField("token", request.token, "needs the acquisition that it belongs to")
        return None
    row = acquisitions.find(session, request.acquisition)
    if row.project_id != project.id:
        raise UnknownResource(f"acquisition of project {project.id}", request.acquisition)
    if request.token != row.token:
        raise InvalidLeaseToken(row.id, request.token)
    return row


def _check_budget(project: ProjectRow, created: int) -> None:
    """Acquired labels were reserved; uploads without a lease must find room too."""
    total = projects.policy_of(project).label_budget
    if total is not None and project.pool_labels > total:
        raise BudgetExhausted(created, total - (project.pool_labels - created), total)


def _items(project: ProjectRow, upload: LabeledUpload) -> list[LabelItem]:
    """The labels of an upload's segments."""
    name, total = upload.stored.source, upload.stored.transitions
    if len(upload.actions) != total:
        raise InvalidLabel(f"{name}.actions: length", len(upload.actions), f"must be {total}, one a transition")
    if upload.action_sets is not None and len(upload.action_sets) != total:
        raise InvalidLabel(f"{name}.action_sets: length", len(upload.action_sets), f"must be {total}")
    count = pool.segment_count(total, project.segment_length, project.stride)
    starts = range(0, count * project.stride, project.stride) if upload.starts is None else upload.starts
    for start in starts:
        _check_start(project, count, start, f"{name}.starts")
    sets = upload.action_sets
    return [
        LabelItem(
            trajectory=upload.stored.id,
            start=start,
            actions=list(upload.actions[start : start + project.segment_length]),
            action_sets=None if sets is None else list(sets[start : start + project.segment_length]),
            residual=None,
        )
        for start in starts
    ]


def _member(session: Session, project: ProjectRow, item: LabelItem) -> MembershipRow:
    member = pool_queries.membership(session, project.id, item.trajectory)
    if member is None:
        raise UnknownResource(f"trajectory in project {project.id}", item.trajectory)
    return member


def _check_segment(session: Session, project: ProjectRow, member: MembershipRow, item: LabelItem) -> None:
    name = f"segment {item.trajectory}:{item.start}"
    _check_start(project, member.segments, item.start, f"{name}.start")
    if len(item.actions) != project.segment_length:
        raise InvalidLabel(f"{name}.actions: length", len(item.actions), f"must be {project.segment_length}")
    check_actions(projects.spaces_of(project), item.actions, item.action_sets, name)


def _check_start(project: ProjectRow, segments: int, start: int, name: str) -> None:
    if not segments:
        raise InvalidLabel(name, start, f"is in a trajectory of less than {project.segment_length} transitions")
    last = (segments - 1) * project.stride
    if start % project.stride or not 0 <= start <= last:
        raise InvalidLabel(name, start, f"must be a multiple of {project.stride} up to {last}")


def _check_lease(
    session: Session, project: ProjectRow, item: LabelItem, acquisition: AcquisitionRow | None, now: datetime
) -> None:
    """A segment takes labels from the holder of its newest claim, or from anybody while no lease on it lives."""
    claim = claim_queries.claim_on(session, project.id, item.trajectory, item.start)
    if acquisition is not None and (claim is None or claim.token != acquisition.token):
        raise LeaseLost(acquisition.id, f"it does not hold segment {item.trajectory}:{item.start}")
    if acquisition is None and claim is not None and claim.expires_at > now:
        raise SegmentLeased(item.trajectory, item.start, claim.expires_at)
    if claim is not None:
        session.delete(claim)


def _store(
    session: Session,
    project: ProjectRow,
    member: MembershipRow,
    item: LabelItem,
    digest: str,
    source: LabelSource,
    acquisition: AcquisitionRow | None,
    now: datetime,
) -> None:
    project.label_watermark += 1
    project.pool_labels += member.split == "pool"
    row = LabelRow(
        project_id=project.id,
        trajectory_id=item.trajectory,
        start=item.start,
        split=member.split,
        actions=list(item.actions),
        action_sets=None if item.action_sets is None else list(item.action_sets),
        content_sha256=digest,
        residual=item.residual,
        source=source.model_dump(mode="json"),
        acquisition_id=acquisition.id if acquisition else None,
        watermark=project.label_watermark,
        created_at=now,
    )
    session.add(row)
    claim_queries.drop_from_queues(session, project.id, item.trajectory, item.start)


def _content_sha256(item: LabelItem) -> str:
    """What makes two labels the same: the sets of actions that explain the steps, or the actions where there are none.

    So a simulator that draws another action from the same set sends a duplicate and not a conflict.
    """
    content: list[object]
    if item.action_sets:
        content = [sorted(set(choices)) for choices in item.action_sets]
    else:
        content = [[action] if isinstance(action, int) else action for action in item.actions]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _shown(label: LabelRow | LabelItem) -> object:
    return label.action_sets or label.actions


def _receipt(item: LabelItem, member: MembershipRow, status: str) -> LabelReceipt:
    fields = {"trajectory": item.trajectory, "start": item.start, "status": status, "split": member.split}
    return LabelReceipt.model_validate(fields)
