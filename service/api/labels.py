"""/labels."""

from datetime import datetime
from uuid import UUID

from fastapi import APIRouter, Request, Response

from api_schemas.base import Page
from api_schemas.environments import Spaces
from api_schemas.labels import MOST_SEGMENTS, Label, LabelsAccepted, LabelsRequest
from service import labels, pool, projects, streams
from service.actions import InvalidLabel, LabelConflict, check_actions
from service.api.access import CallerDep, by_body, by_query, requires
from service.api.dependencies import Cursor, Now, PageSize, ReadSession, Services, ServicesDep
from service.api.description import refuses
from service.api.once import Answer, IdempotencyKey, answered_once, kept_answer, key_use
from service.errors import InvalidField
from service.idempotency import IdempotencyKeyReused, KeyUse
from service.labels import LabeledUpload
from service.leases import InvalidLeaseToken, LeaseLost, SegmentLeased
from service.pool import SplitConflict
from service.store.errors import BlobsUnavailable, ForeignFile, KeyBusy
from service.store.queries.listing import page
from service.store.tables import LabelRow, ProjectRow
from service.streams import InvalidTrajectory

router = APIRouter(prefix="/labels", tags=["labels"])


@router.post(
    "",
    status_code=201,
    response_model=LabelsAccepted,
    responses=refuses(
        ForeignFile,
        InvalidLeaseToken,
        LabelConflict,
        SplitConflict,
        LeaseLost,
        InvalidLabel,
        InvalidTrajectory,
        IdempotencyKeyReused,
        SegmentLeased,
        BlobsUnavailable,
        KeyBusy,
    ),
    dependencies=[requires("label", by_body)],
)
def add_labels(
    request: LabelsRequest,
    held: ServicesDep,
    now: Now,
    http: Request,
    who: CallerDep,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    if not request.items and not request.trajectories:
        raise InvalidField("items", [], "must hold a label, or trajectories a labeled trajectory")
    use = key_use(http, who, idempotency_key, request)
    if request.trajectories and (kept := _kept(held, use, now)):
        return kept.response()
    uploads = _store_trajectories(held, request)
    with held.database.write() as session:

        def rule() -> Answer:
            accepted = labels.accept(session, request, uploads, held.clock, held.settings.job_max_attempts)
            return Answer(201, accepted.model_dump_json())

        answer = answered_once(session, use, held.settings, now, rule)
    return answer.response()


@router.get("", dependencies=[requires("read", by_query)])
def list_labels(project: UUID, session: ReadSession, cursor: Cursor = None, limit: PageSize = 100) -> Page[Label]:
    projects.find(session, project)
    rows, after = page(session, LabelRow, [LabelRow.project_id == project], (LabelRow.watermark,), cursor, limit)
    return Page(items=[labels.describe(row) for row in rows], next=after)


def _kept(held: Services, use: KeyUse | None, now: datetime) -> Answer | None:
    """Asked before any blob is stored: a repetition needs neither the work nor the blob store."""
    with held.database.read() as session:
        return kept_answer(session, use, now)


def _check_size(project: ProjectRow, request: LabelsRequest) -> None:
    """One transaction, under the project's lock, writes a row a segment. Raises InvalidField."""
    total = sum(
        pool.segment_count(len(one.actions), project.segment_length, project.stride)
        if one.starts is None
        else len(one.starts)
        for one in request.trajectories
    )
    if total > MOST_SEGMENTS:
        reason = f"must hold at most {MOST_SEGMENTS} segments in one request; `starts` chooses some of a trajectory's"
        raise InvalidField("trajectories: segments", total, reason)


def _store_trajectories(held: Services, request: LabelsRequest) -> list[LabeledUpload]:
    """Blobs first, outside the transaction: they are named by content, so a crash before the rows does no harm."""
    if not request.trajectories:
        return []
    with held.database.read() as session:
        project = projects.find(session, request.project)
        spaces: Spaces = projects.spaces_of(project)
    _check_size(project, request)
    names = [f"trajectories[{position}]" for position in range(len(request.trajectories))]
    for name, trajectory in zip(names, request.trajectories, strict=True):
        check_actions(spaces, trajectory.actions, trajectory.action_sets, name)
    files = [(f"{name}.content", one.content) for name, one in zip(names, request.trajectories, strict=True)]
    arrays = streams.read(spaces, files, held.settings.max_body_bytes)
    return [
        LabeledUpload(
            pool.write(held.blobs, spaces, observed, name),
            trajectory.actions,
            trajectory.action_sets,
            trajectory.starts,
            trajectory.split,
            rank=trajectory.rank,
        )
        for name, observed, trajectory in zip(names, arrays, request.trajectories, strict=True)
    ]
