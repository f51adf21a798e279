"""/strategies, /keys, /health and /metrics."""

from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from uuid import UUID

from fastapi import APIRouter, Response
from fastapi.responses import JSONResponse, RedirectResponse
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from sqlalchemy.exc import SQLAlchemyError

from api_schemas.base import Page
from api_schemas.keys import Health, Key, KeyCreate, KeyCreated
from api_schemas.strategies import CATALOG, Strategy
from service import canary, keys
from service.api.access import narrowed, requires
from service.api.dependencies import Cursor, Now, PageSize, ReadSession, Services, ServicesDep, WriteSession
from service.log import get_logger
from service.metrics import gauges
from service.store.queries import jobs as job_queries
from service.store.queries.listing import page
from service.store.tables import KeyRow

router = APIRouter(tags=["system"])
log = get_logger("api")


@router.get("/", include_in_schema=False)
def home() -> RedirectResponse:
    return RedirectResponse("/dashboard")


@router.get("/strategies", dependencies=[requires("read", narrowed)])
def list_strategies() -> list[Strategy]:
    return list(CATALOG)


@router.post("/keys", status_code=201, dependencies=[requires("admin")])
def create_key(request: KeyCreate, session: WriteSession, now: Now, response: Response) -> KeyCreated:
    created = keys.create(session, request, now)
    response.headers["Location"] = f"/keys/{created.id}"
    return created


@router.get("/keys", dependencies=[requires("admin")])
def list_keys(session: ReadSession, cursor: Cursor = None, limit: PageSize = 100) -> Page[Key]:
    rows, after = page(session, KeyRow, [], (KeyRow.created_at, KeyRow.id), cursor, limit)
    return Page(items=[keys.describe(row) for row in rows], next=after)


@router.delete("/keys/{key_id}", status_code=204, dependencies=[requires("admin")])
def revoke_key(key_id: UUID, session: WriteSession, now: Now) -> None:
    keys.revoke(session, key_id, now)


@router.get("/health/live")
async def live() -> dict[str, str]:
    return {"status": "ok"}


@router.get("/health/ready", response_model=Health, responses={503: {"model": Health}})
def ready(held: ServicesDep, now: Now) -> JSONResponse:
    work = _work_state(held, now)
    blobs = held.blobs.reachable()
    healthy = blobs and work is not None and work.served
    body = Health(
        status="ok" if healthy else "unavailable",
        database=work is not None,
        blobs=blobs,
        workers_alive=work.workers if work else 0,
        canaries=work.canaries if work else dict.fromkeys(canary.QUEUES),
        version=version("asim"),
    )
    return JSONResponse(body.model_dump(), 200 if healthy else 503)


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"description": "Prometheus metrics", "content": {"text/plain": {}}}},
    dependencies=[requires("read")],
)
def metrics(session: ReadSession, now: Now, held: ServicesDep) -> Response:
    told = generate_latest(gauges(session, now)) + generate_latest(held.answered.registry)
    return Response(told, media_type=CONTENT_TYPE_LATEST)


@dataclass(frozen=True)
class _WorkState:
    """Workers heard of lately, the canaries' ages, and whether every queue is served."""

    workers: int
    canaries: dict[str, float | None]
    served: bool


def _work_state(held: Services, now: datetime) -> _WorkState | None:
    """What the database says of the work; None where it does not answer."""
    try:
        with held.database.read() as session:
            return _WorkState(
                job_queries.live_workers(session, now - canary.WORKER_SILENCE),
                canary.ages(session, now),
                all(canary.healthy(session, now, held.settings.canary_seconds).values()),
            )
    except SQLAlchemyError as error:
        log.warning("database_unreachable", error=str(error))
        return None
