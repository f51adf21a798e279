"""/policies."""

from uuid import UUID

from fastapi import APIRouter, Response

from api_schemas.base import Page
from api_schemas.jobs import Job
from api_schemas.policies import Policy, PolicyCreate
from service import jobs, policies, projects
from service.api.access import by_body, by_query, requires
from service.api.dependencies import Cursor, Now, PageSize, ReadSession, ServicesDep, WriteSession
from service.api.description import refuses
from service.errors import NoSimulator
from service.policies import PoliciesOutOfReach
from service.store.errors import BlobsUnavailable
from service.store.queries.listing import page
from service.store.tables import PolicyRow

router = APIRouter(tags=["policies"])


@router.post("/policies", status_code=202, responses=refuses(NoSimulator), dependencies=[requires("admin", by_body)])
def train_policy(request: PolicyCreate, session: WriteSession, held: ServicesDep, now: Now, response: Response) -> Job:
    row = policies.request(session, request, now, held.settings.job_max_attempts)
    response.headers.update({"Location": f"/jobs/{row.id}", "Retry-After": "1"})
    return jobs.describe(row)


@router.get("/policies", dependencies=[requires("read", by_query)])
def list_policies(project: UUID, session: ReadSession, cursor: Cursor = None, limit: PageSize = 100) -> Page[Policy]:
    projects.find(session, project)
    key = (PolicyRow.created_at, PolicyRow.sha256)
    rows, after = page(session, PolicyRow, [PolicyRow.project_id == project], key, cursor, limit)
    return Page(items=[policies.describe(row) for row in rows], next=after)


@router.get(
    "/policies/{policy_id}/weights",
    response_class=Response,
    responses={
        200: {"description": "A safetensors file", "content": {"application/octet-stream": {}}},
        **refuses(PoliciesOutOfReach, BlobsUnavailable),
    },
    dependencies=[requires("label", by_query)],
)
def policy_weights(policy_id: str, project: UUID, held: ServicesDep) -> Response:
    """They tell which actions a trajectory came of, as its provenance does."""
    with held.database.read() as session:
        row = policies.find(session, project, policy_id)
    if held.provenance is None:
        raise PoliciesOutOfReach(f"policy {row.sha256}")
    data = held.provenance.get("policies", row.sha256)
    name = f"policy-{row.sha256}.safetensors"
    headers = {"ETag": f'"{row.sha256}"', "Content-Disposition": f'attachment; filename="{name}"'}
    return Response(data, headers=headers, media_type="application/octet-stream")
