"""/acquire and /acquisitions."""

import time
from uuid import UUID

import anyio
from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from api_schemas.acquisitions import AcquireRequest, Acquisition, AcquisitionPending, ExtendRequest, ReleaseRequest
from service import acquisitions, jobs, leases
from service.api.access import By, CallerDep, by_body, requires
from service.api.dependencies import Now, ReadSession, Services, ServicesDep, WriteSession
from service.api.description import refuses
from service.api.once import Answer, IdempotencyKey, Prefer, answered_once, key_use, wait_seconds
from service.draws import PoolExhausted
from service.errors import NoModelFamily, PrivilegedStrategy, UnknownStrategy
from service.idempotency import IdempotencyKeyReused, KeyUse
from service.leases import BudgetExhausted, InvalidLeaseToken, LeaseLost
from service.proposals import AllExplored, NothingToExplore
from service.store.errors import KeyBusy
from service.store.tables import AcquisitionRow, JobRow

router = APIRouter(tags=["acquisitions"])
by_acquisition = By(AcquisitionRow, "acquisition")
POLL_SECONDS = 0.1


@router.post(
    "/acquire",
    status_code=201,
    response_model=Acquisition,
    responses={
        202: {"model": AcquisitionPending, "description": "No ranked queue is ready; poll the job, then ask again"},
        **refuses(
            UnknownStrategy,
            PrivilegedStrategy,
            PoolExhausted,
            BudgetExhausted,
            NothingToExplore,
            AllExplored,
            NoModelFamily,
            IdempotencyKeyReused,
            KeyBusy,
        ),
    },
    dependencies=[requires("acquire", by_body)],
)
async def acquire(
    request: AcquireRequest,
    held: ServicesDep,
    http: Request,
    who: CallerDep,
    idempotency_key: IdempotencyKey = None,
    prefer: Prefer = None,
) -> Response:
    use, deadline = key_use(http, who, idempotency_key, request), time.monotonic() + wait_seconds(prefer)
    answer = await run_in_threadpool(_acquired, held, request, use)
    while answer.status == 202 and time.monotonic() < deadline:  # no thread and no transaction is held meanwhile
        await anyio.sleep(POLL_SECONDS)
        state = await run_in_threadpool(_state, held, AcquisitionPending.model_validate_json(answer.body).job)
        if state in ("failed", "cancelled"):
            break  # who asked learns of it from the job that the answer names, and may ask again
        if await http.is_disconnected():
            break  # nobody would label what was leased now
        if state == "done":
            answer = await run_in_threadpool(_acquired, held, request, use)
    response = answer.response()
    if wait_seconds(prefer):
        response.headers["Preference-Applied"] = f"wait={wait_seconds(prefer):.0f}"
    return response


@router.get("/acquisitions/{acquisition_id}", dependencies=[requires("read", by_acquisition)])
def show_acquisition(acquisition_id: UUID, session: ReadSession, now: Now) -> Acquisition:
    row = leases.find(session, acquisition_id)
    return acquisitions.describe(session, row, now, with_token=False)


@router.post(
    "/acquisitions/{acquisition_id}/extend",
    responses=refuses(InvalidLeaseToken, BudgetExhausted, LeaseLost),
    dependencies=[requires("acquire", by_acquisition)],
)
def extend(acquisition_id: UUID, request: ExtendRequest, session: WriteSession, held: ServicesDep) -> Acquisition:
    row = leases.extend(session, acquisition_id, request.token, request.lease_seconds, held.clock)
    return acquisitions.describe(session, row, held.clock(), with_token=True)


@router.post(
    "/acquisitions/{acquisition_id}/release",
    responses=refuses(InvalidLeaseToken, LeaseLost),
    dependencies=[requires("acquire", by_acquisition)],
)
def release(acquisition_id: UUID, request: ReleaseRequest, session: WriteSession, held: ServicesDep) -> Acquisition:
    row = leases.release(session, acquisition_id, request.token, held.clock)
    return acquisitions.describe(session, row, held.clock(), with_token=False)


def _acquired(held: Services, request: AcquireRequest, use: KeyUse | None) -> Answer:
    """One attempt in a transaction of its own."""
    with held.database.write() as session:
        now = held.clock()

        def rule() -> Answer:
            given = acquisitions.acquire(session, request, held.clock, held.limits)
            if isinstance(given, JobRow):
                return _pending(given)
            return Answer(201, given.model_dump_json(), f"/acquisitions/{given.id}")

        return answered_once(session, use, held.settings, now, rule)


def _pending(job: JobRow) -> Answer:
    detail = f"no ranked queue is ready yet; job {job.id} ({job.kind}) is {job.state}"
    body = AcquisitionPending(detail=detail, job=job.id)
    return Answer(202, body.model_dump_json(), f"/jobs/{job.id}", {"Retry-After": "1"})


def _state(held: Services, job_id: UUID) -> str:
    with held.database.read() as session:
        return jobs.find(session, job_id).state
