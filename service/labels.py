"""Labels: the actions of a segment, accepted once and never overwritten."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal
from uuid import uuid4

from sqlalchemy.orm import Session

from api_schemas.environments import Spaces
from api_schemas.labels import (
    Action,
    Label,
    LabelItem,
    LabelReceipt,
    LabelsAccepted,
    LabelsRequest,
)
from api_schemas.trajectories import SplitChoice
from service import events, explorations, leases, pool, projects, rounds
from service.actions import InvalidLabel, LabelConflict, check_actions
from service.clock import Clock
from service.errors import InvalidField, UnknownResource
from service.leases import InvalidLeaseToken, LeaseLost, SegmentLeased
from service.pool import StoredTrajectory
from service.store.queries import acquisitions as claim_queries
from service.store.queries import labels as queries
from service.store.queries import pool as pool_queries
from service.store.queries.acquisitions import Claim
from service.store.queries.labels import StoredLabel
from service.store.queries.pool import Membership
from service.store.queries.segments import Segment
from service.store.tables import AcquisitionRow, LabelRow, ProjectRow


@dataclass(frozen=True)
class LabeledUpload:
    """A labeled trajectory whose blob is written: all its actions, and the segments to record (None: all).

    rank: the explore item that it answers.
    """

    stored: StoredTrajectory
    actions: Sequence[Action]
    action_sets: Sequence[list[int]] | None
    starts: Sequence[int] | None
    split: SplitChoice
    provenance_sha256: str | None = None
    rank: int | None = None


@dataclass
class _Batch:
    """One request while it is accepted: what is there of its segments, and what comes of it.

    uploaded: segments of whole trajectories, which need no lease.
    """

    project: ProjectRow
    watermark: int
    source: dict[str, object]
    acquisition: AcquisitionRow | None
    now: datetime
    members: dict[str, Membership]
    labels: dict[Segment, StoredLabel]
    claims: dict[Segment, Claim]
    uploaded: frozenset[Segment]
    receipts: list[LabelReceipt] = field(default_factory=list)
    created: list[dict[str, object]] = field(default_factory=list)
    unreserved: int = 0


def accept(
    session: Session, request: LabelsRequest, uploads: Sequence[LabeledUpload], clock: Clock, max_attempts: int = 3
) -> LabelsAccepted:
    """Store all labels or none, in the caller's transaction, and ask for a round when enough have come.

    uploads: the request's labeled trajectories, stored. Raises UnknownResource, InvalidLabel, InvalidLeaseToken,
    LeaseLost, SegmentLeased, LabelConflict, SplitConflict, BudgetExhausted.
    """
    members = _fitting(session, projects.find(session, request.project), request.items)
    pool.keep(session, [upload.stored for upload in uploads], clock())
    project = projects.find(session, request.project, lock=True)
    now = clock()  # under the lock: while it was waited for a lease may have ended
    acquisition = _acquisition(session, project, request)
    uploaded, reserved = _take_uploads(session, project, acquisition, uploads, now)
    members |= _fitting(session, project, uploaded)
    batch = _batch(session, project, request, acquisition, uploaded, members, now)
    for item in (*uploaded, *request.items):
        batch.receipts.append(_accept_item(batch, item))
    _store(session, batch)
    if acquisition is not None:
        leases.close_if_labeled(session, acquisition, now)
    if batch.unreserved > reserved:
        leases.check_budget(session, project, batch.unreserved - reserved, now)
    wanted = bool(batch.created) and rounds.due(project)
    round_row = rounds.request(session, project, now, max_attempts) if wanted else None
    return LabelsAccepted(
        receipts=batch.receipts,
        created=len(batch.created),
        duplicates=len(batch.receipts) - len(batch.created),
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


def _take_uploads(
    session: Session,
    project: ProjectRow,
    acquisition: AcquisitionRow | None,
    uploads: Sequence[LabeledUpload],
    now: datetime,
) -> tuple[list[LabelItem], int]:
    """The labels of uploaded trajectories, which become members first; and how many live leases had reserved them."""
    taken: list[LabelItem] = []
    reserved = 0
    _join(session, project, uploads, now)
    for position, upload in enumerate(uploads):
        items = _items(project, upload)
        if upload.rank is not None:
            if not items:
                reason = f"must be at least 1: an exploration brings a segment of {project.segment_length} transitions"
                raise InvalidLabel(f"{upload.stored.source}.starts: length", 0, reason)
            name = upload.stored.id
            reserved += explorations.answer(session, project, acquisition, upload.rank, name, position, now)
        taken += items
    return taken, reserved


def _join(session: Session, project: ProjectRow, uploads: Sequence[LabeledUpload], now: datetime) -> None:
    """The uploads become members; what answers an exploration joins the pool."""
    by_split: dict[SplitChoice, list[tuple[StoredTrajectory, str | None]]] = {}
    for upload in uploads:
        split: SplitChoice = upload.split if upload.rank is None else "pool"
        by_split.setdefault(split, []).append((upload.stored, upload.provenance_sha256))
    for split, stored in by_split.items():
        pool.add_all(session, project, stored, split, now)


def _fitting(session: Session, project: ProjectRow, items: Sequence[LabelItem]) -> dict[str, Membership]:
    """The members that the items are about, all of which fit their segments. Needs no lock: none of it ever changes."""
    members = pool_queries.memberships_of(session, project.id, sorted({item.trajectory for item in items}))
    spaces = projects.spaces_of(project)
    for item in items:
        _check_segment(project, spaces, members.get(item.trajectory), item)
    return members


def _batch(
    session: Session,
    project: ProjectRow,
    request: LabelsRequest,
    acquisition: AcquisitionRow | None,
    uploaded: Sequence[LabelItem],
    members: dict[str, Membership],
    now: datetime,
) -> _Batch:
    """What there is of the segments: a few statements for any number of them."""
    segments = [(item.trajectory, item.start) for item in (*uploaded, *request.items)]
    return _Batch(
        project=project,
        watermark=project.label_watermark,
        source=request.source.model_dump(mode="json"),
        acquisition=acquisition,
        now=now,
        members=members,
        labels=queries.labels_of(session, project.id, segments),
        claims=claim_queries.claims_on(session, project.id, segments),
        uploaded=frozenset((item.trajectory, item.start) for item in uploaded),
    )


def _accept_item(batch: _Batch, item: LabelItem) -> LabelReceipt:
    member = batch.members[item.trajectory]
    digest, segment = _content_sha256(item), (item.trajectory, item.start)
    stored = batch.labels.get(segment)
    if stored is not None:
        if stored.content_sha256 != digest:
            raise LabelConflict(item.trajectory, item.start, stored.shown, item.action_sets or item.actions)
        return _receipt(item, member, "duplicate")
    _check_lease(batch, item)
    batch.labels[segment] = StoredLabel(digest, item.action_sets or item.actions)
    batch.created.append(_row(batch, member, item, digest))
    return _receipt(item, member, "created")


def _acquisition(session: Session, project: ProjectRow, request: LabelsRequest) -> AcquisitionRow | None:
    if request.acquisition is None:
        if request.token is not None:
            raise InvalidField("token", request.token, "needs the acquisition that it belongs to")
        return None
    row = leases.find(session, request.acquisition)
    if row.project_id != project.id:
        raise UnknownResource(f"acquisition of project {project.id}", request.acquisition)
    if request.token != row.token:
        raise InvalidLeaseToken(row.id, request.token)
    return row


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


def _check_segment(project: ProjectRow, spaces: Spaces, member: Membership | None, item: LabelItem) -> None:
    if member is None:
        raise UnknownResource(f"trajectory in project {project.id}", item.trajectory)
    name, length = f"segment {item.trajectory}:{item.start}", project.segment_length
    _check_start(project, member.segments, item.start, f"{name}.start")
    if len(item.actions) != length:
        raise InvalidLabel(f"{name}.actions: length", len(item.actions), f"must be {length}")
    check_actions(spaces, item.actions, item.action_sets, name)


def _check_start(project: ProjectRow, segments: int, start: int, name: str) -> None:
    if not segments:
        raise InvalidLabel(name, start, f"is in a trajectory of less than {project.segment_length} transitions")
    last = (segments - 1) * project.stride
    if start % project.stride or not 0 <= start <= last:
        raise InvalidLabel(name, start, f"must be a multiple of {project.stride} up to {last}")


def _check_lease(batch: _Batch, item: LabelItem) -> None:
    """A segment takes labels from the holder of its newest claim, or from anybody while no lease on it lives.

    What no live claim had reserved needs room in the budget: an answer after the lease's end, an upload without one.
    """
    segment = (item.trajectory, item.start)
    claim, acquisition = batch.claims.get(segment), batch.acquisition
    holds = claim is not None and acquisition is not None and claim.token == acquisition.token
    lives = claim is not None and claim.expires_at > batch.now
    if acquisition is not None and not holds and segment not in batch.uploaded:
        raise LeaseLost(acquisition.id, f"it does not hold segment {item.trajectory}:{item.start}")
    if claim is not None and lives and not holds:
        raise SegmentLeased(item.trajectory, item.start, claim.expires_at)
    batch.unreserved += not (holds and lives) and batch.members[item.trajectory].split == "pool"


def _row(batch: _Batch, member: Membership, item: LabelItem, digest: str) -> dict[str, object]:
    """The next label of the project, by column; its watermark is taken under the project's lock."""
    batch.watermark += 1
    return {
        "id": uuid4(),
        "project_id": batch.project.id,
        "trajectory_id": item.trajectory,
        "start": item.start,
        "split": member.split,
        "actions": list(item.actions),
        "action_sets": None if item.action_sets is None else list(item.action_sets),
        "content_sha256": digest,
        "residual": item.residual,
        "source": batch.source,
        "acquisition_id": batch.acquisition.id if batch.acquisition else None,
        "watermark": batch.watermark,
        "created_at": batch.now,
    }


def _store(session: Session, batch: _Batch) -> None:
    """The new labels, and what follows: their segments are claimed by nobody and stand in no queue."""
    if not batch.created:
        return
    project, pool_labels = batch.project, sum(row["split"] == "pool" for row in batch.created)
    segments = [(str(row["trajectory_id"]), int(str(row["start"]))) for row in batch.created]
    queries.insert(session, batch.created)
    claim_queries.drop_claims(session, project.id, [segment for segment in segments if segment in batch.claims])
    claim_queries.drop_from_queues(session, project.id, segments)
    project.label_watermark = batch.watermark  # last: a statement after this one would write the row by itself
    project.pool_labels += pool_labels
    project.held_out_labels += len(batch.created) - pool_labels
    data: dict[str, object] = {
        "count": len(batch.created),
        "first": batch.created[0]["watermark"],
        "watermark": project.label_watermark,
        "by": batch.source["name"],
        "acquisition": str(batch.acquisition.id) if batch.acquisition else None,
    }
    events.record(session, project.id, "labels.accepted", data, batch.now)


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


def _receipt(item: LabelItem, member: Membership, status: Literal["created", "duplicate"]) -> LabelReceipt:
    return LabelReceipt(trajectory=item.trajectory, start=item.start, status=status, split=member.split)
