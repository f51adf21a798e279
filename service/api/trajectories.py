"""/trajectories and /collections."""

from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Depends, Query, Response

from api_schemas.base import Page
from api_schemas.collections import CollectionCreate
from api_schemas.jobs import CollectionStarted
from api_schemas.trajectories import SplitChoice, TrajectoriesAdded, Trajectory
from service import collections, pool, projects, streams
from service.api.access import CallerDep, by_body, by_query, requires
from service.api.dependencies import Cursor, Now, PageSize, ReadSession, ServicesDep, WriteSession
from service.api.description import refuses
from service.api.uploads import DESCRIBED, Upload, uploads
from service.errors import InvalidField, NoSimulator, UnknownBehavior
from service.pool import NoProvenance, SplitConflict
from service.store import codec, npz
from service.store.errors import BlobsUnavailable, ForeignFile
from service.store.queries import labels as label_queries
from service.store.queries import pool as pool_queries
from service.store.queries.listing import page
from service.store.tables import MembershipRow
from service.streams import InvalidTrajectory

router = APIRouter(tags=["trajectories"])
reader, labeler = requires("read", by_query), requires("label", by_query)
Start = Annotated[int, Query(ge=0, description="first observation")]
Length = Annotated[int | None, Query(ge=0, description="transitions after it; default to the end")]
Files = Annotated[list[Upload], Depends(uploads)]
NPZ = "application/octet-stream"
NPZ_FILE: dict[int | str, dict[str, Any]] = {
    200: {"description": "An npz file, one array a stream, time first", "content": {NPZ: {}}}
}


@router.post(
    "/trajectories",
    status_code=201,
    responses=refuses(ForeignFile, InvalidTrajectory, SplitConflict, BlobsUnavailable),
    dependencies=[labeler],
    openapi_extra=DESCRIBED,
)
def add_trajectories(
    project: UUID, files: Files, held: ServicesDep, now: Now, split: SplitChoice = "auto"
) -> TrajectoriesAdded:
    with held.database.read() as session:
        spaces = projects.spaces_of(projects.find(session, project))
    # Blobs first: they are named by content, so a crash before the rows leaves nothing wrong behind.
    arrays = streams.read(spaces, files, held.settings.max_body_bytes)
    stored = [pool.write(held.blobs, spaces, each, file.name) for file, each in zip(files, arrays, strict=True)]
    with held.database.write() as session:
        pool.keep(session, stored, now)
        row = projects.find(session, project, lock=True)
        return TrajectoriesAdded(items=pool.add_all(session, row, [(item, None) for item in stored], split, now))


@router.get("/trajectories", dependencies=[reader])
def list_trajectories(
    project: UUID, session: ReadSession, cursor: Cursor = None, limit: PageSize = 100
) -> Page[Trajectory]:
    projects.find(session, project)
    rows, after = page(
        session, MembershipRow, [MembershipRow.project_id == project], (MembershipRow.id,), cursor, limit
    )
    ids = [row.trajectory_id for row in rows]
    contents = pool_queries.contents(session, ids)
    labeled = label_queries.labeled_by_trajectory(session, project, ids)
    items = [pool.describe(row, contents[row.trajectory_id], labeled.get(row.trajectory_id, 0)) for row in rows]
    return Page(items=items, next=after)


@router.get("/trajectories/{trajectory_id}", dependencies=[reader])
def show_trajectory(trajectory_id: str, project: UUID, session: ReadSession) -> Trajectory:
    member, content = pool.find(session, projects.find(session, project), trajectory_id)
    labeled = label_queries.labeled_by_trajectory(session, project, [trajectory_id])
    return pool.describe(member, content, labeled.get(trajectory_id, 0))


@router.get(
    "/trajectories/{trajectory_id}/content",
    dependencies=[reader],
    response_class=Response,
    responses=refuses(BlobsUnavailable) | NPZ_FILE,
)
def trajectory_content(
    trajectory_id: str, project: UUID, held: ServicesDep, start: Start = 0, length: Length = None
) -> Response:
    with held.database.read() as session:
        _, content = pool.find(session, projects.find(session, project), trajectory_id)
    stop = _stop(content.transitions, start, length)
    data = held.blobs.get("trajectories", content.blob_sha256)
    arrays, _ = codec.decode(data, f"trajectory {trajectory_id}", start, stop)
    return Response(npz.dump(arrays), media_type=NPZ)


@router.get(
    "/trajectories/{trajectory_id}/provenance",
    dependencies=[labeler],
    response_class=Response,
    responses=refuses(NoProvenance, BlobsUnavailable) | NPZ_FILE,
)
def trajectory_provenance(
    trajectory_id: str, project: UUID, held: ServicesDep, start: Start = 0, length: Length = None
) -> Response:
    with held.database.read() as session:
        member, content = pool.find(session, projects.find(session, project), trajectory_id)
    if member.provenance_sha256 is None or held.provenance is None:
        raise NoProvenance(trajectory_id)
    stop = _stop(content.transitions, start, length)
    data = held.provenance.get("provenance", member.provenance_sha256)
    states, extra = codec.decode(data, f"provenance of {trajectory_id}", start, stop)
    return Response(npz.dump(states, extra["metadata"]), media_type=NPZ)


@router.post(
    "/collections",
    status_code=202,
    responses=refuses(NoSimulator, UnknownBehavior),
    dependencies=[requires("admin", by_body)],
)
def collect(
    request: CollectionCreate, session: WriteSession, held: ServicesDep, who: CallerDep, now: Now, response: Response
) -> CollectionStarted:
    rows = collections.request(session, request, now, held.settings.job_max_attempts, who.project)
    response.headers.update({"Location": f"/jobs/{rows[0].id}", "Retry-After": "1"})
    return collections.started(rows)


def _stop(transitions: int, start: int, length: int | None) -> int:
    """One past the last observation of the window."""
    last = transitions if length is None else start + length
    if last > transitions or start > transitions:
        raise InvalidField("start + length", last, f"must be at most {transitions}, the trajectory's transitions")
    return last + 1
