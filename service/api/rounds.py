"""/rounds, /models and /model-error."""

import hashlib
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Header, Response

from api_schemas.base import Page
from api_schemas.models import ModelVersion
from api_schemas.rounds import ModelErrorCurve, Round, RoundCreate
from service import projects, registry, rounds
from service.api.access import By, by_body, by_query, requires
from service.api.dependencies import Cursor, Now, PageSize, ReadSession, ServicesDep, WriteSession
from service.api.description import refuses
from service.errors import NoModelFamily, NothingToLearn
from service.store.errors import BlobsUnavailable
from service.store.queries.listing import page
from service.store.tables import ModelVersionRow, RoundRow

router = APIRouter(tags=["rounds"])
reader = requires("read", by_query)
by_round, by_model = By(RoundRow, "round"), By(ModelVersionRow, "model")


@router.post(
    "/rounds",
    status_code=202,
    responses=refuses(NoModelFamily, NothingToLearn),
    dependencies=[requires("admin", by_body)],
)
def start_round(request: RoundCreate, session: WriteSession, held: ServicesDep, now: Now, response: Response) -> Round:
    project = projects.find(session, request.project, lock=True)
    row = rounds.request(session, project, now, held.settings.job_max_attempts)
    response.headers.update({"Location": f"/rounds/{row.id}", "Retry-After": "1"})
    return rounds.describe(session, row)


@router.get("/rounds", dependencies=[reader])
def list_rounds(project: UUID, session: ReadSession, cursor: Cursor = None, limit: PageSize = 100) -> Page[Round]:
    projects.find(session, project)
    rows, after = page(
        session, RoundRow, [RoundRow.project_id == project], (RoundRow.number,), cursor, limit, newest_first=True
    )
    return Page(items=[rounds.describe(session, row) for row in rows], next=after)


@router.get("/rounds/{round_id}", dependencies=[requires("read", by_round)])
def show_round(round_id: UUID, session: ReadSession) -> Round:
    return rounds.describe(session, rounds.find(session, round_id))


@router.get(
    "/model-error",
    response_model=ModelErrorCurve,
    responses={304: {"description": "The curve is the one that If-None-Match names"}},
    dependencies=[reader],
)
def model_error(project: UUID, session: ReadSession, if_none_match: Annotated[str | None, Header()] = None) -> Response:
    body = rounds.curve(session, projects.find(session, project)).model_dump_json().encode()
    etag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    headers = {"ETag": etag, "Cache-Control": "no-cache"}
    if if_none_match is not None and etag in if_none_match:
        return Response(status_code=304, headers=headers)
    return Response(body, headers=headers, media_type="application/json")


@router.get("/models", dependencies=[reader])
def list_models(
    project: UUID, session: ReadSession, cursor: Cursor = None, limit: PageSize = 100
) -> Page[ModelVersion]:
    projects.find(session, project)
    key = (ModelVersionRow.created_at, ModelVersionRow.id)
    rows, after = page(
        session, ModelVersionRow, [ModelVersionRow.project_id == project], key, cursor, limit, newest_first=True
    )
    return Page(items=[registry.describe(row) for row in rows], next=after)


@router.get("/models/{model_id}", dependencies=[requires("read", by_model)])
def show_model(model_id: UUID, session: ReadSession) -> ModelVersion:
    return registry.describe(registry.find(session, model_id))


@router.get(
    "/models/{model_id}/weights",
    response_class=Response,
    responses={
        200: {"description": "A safetensors file", "content": {"application/octet-stream": {}}},
        **refuses(BlobsUnavailable),
    },
    dependencies=[requires("read", by_model)],
)
def model_weights(model_id: UUID, held: ServicesDep) -> Response:
    with held.database.read() as session:
        row = registry.find(session, model_id)
    data = held.blobs.get("weights", row.sha256)
    name = f"{row.kind}-{row.id}.safetensors"
    headers = {"ETag": f'"{row.sha256}"', "Content-Disposition": f'attachment; filename="{name}"'}
    return Response(data, headers=headers, media_type="application/octet-stream")
