"""/acquire and /acquisitions."""

from uuid import UUID

from fastapi import APIRouter, Depends, Response
from fastapi.responses import JSONResponse

from api_schemas.acquisitions import AcquireRequest, Acquisition, AcquisitionPending, ExtendRequest, ReleaseRequest
from service import acquisitions
from service.api.dependencies import Now, ReadSession, ServicesDep, WriteSession, requires
from service.store.tables import JobRow

router = APIRouter(tags=["acquisitions"])
reader, acquirer = Depends(requires("read")), Depends(requires("acquire"))


@router.post(
    "/acquire",
    status_code=201,
    response_model=Acquisition,
    responses={202: {"model": AcquisitionPending}},
    dependencies=[acquirer],
)
def acquire(
    request: AcquireRequest, session: WriteSession, held: ServicesDep, now: Now, response: Response
) -> Acquisition | JSONResponse:
    given = acquisitions.acquire(session, request, now, held.limits)
    if isinstance(given, JobRow):
        return _pending(given)
    response.headers["Location"] = f"/acquisitions/{given.id}"
    return acquisitions.describe(session, given, now, with_token=True)


@router.get("/acquisitions/{acquisition_id}", dependencies=[reader])
def show_acquisition(acquisition_id: UUID, session: ReadSession, now: Now) -> Acquisition:
    row = acquisitions.find(session, acquisition_id)
    return acquisitions.describe(session, row, now, with_token=False)


@router.post("/acquisitions/{acquisition_id}/extend", dependencies=[acquirer])
def extend(acquisition_id: UUID, request: ExtendRequest, session: WriteSession, now: Now) -> Acquisition:
    row = acquisitions.extend(session, acquisition_id, request.token, request.lease_seconds, now)
    return acquisitions.describe(session, row, now, with_token=True)


@router.post("/acquisitions/{acquisition_id}/release", dependencies=[acquirer])
def release(acquisition_id: UUID, request: ReleaseRequest, session: WriteSession, now: Now) -> Acquisition:
    row = acquisitions.release(session, acquisition_id, request.token, now)
    return acquisitions.describe(session, row, now, with_token=False)


def _pending(job: JobRow) -> JSONResponse:
    detail = f"no ranked queue is ready yet; job {job.id} ({job.kind}) is {job.state}"
    body = AcquisitionPending(detail=detail, job=job.id)
    return JSONResponse(body.model_dump(mode="json"), 202, {"Location": f"/jobs/{job.id}", "Retry-After": "1"})
