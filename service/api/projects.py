"""/projects."""

from uuid import UUID

from fastapi import APIRouter, Response

from api_schemas.base import Page
from api_schemas.projects import Project, ProjectCreate, ProjectPatch
from service import projects
from service.api.access import CallerDep, by_path, narrowed, requires
from service.api.dependencies import Cursor, Now, PageSize, ReadSession, WriteSession
from service.api.description import refuses
from service.errors import NameTaken, PrivilegedStrategy
from service.store.queries.listing import page
from service.store.tables import ProjectRow

router = APIRouter(prefix="/projects", tags=["projects"])


@router.post("", status_code=201, responses=refuses(NameTaken, PrivilegedStrategy), dependencies=[requires("admin")])
def create_project(request: ProjectCreate, session: WriteSession, now: Now, response: Response) -> Project:
    row = projects.create(session, request, now)
    response.headers["Location"] = f"/projects/{row.id}"
    return projects.describe(session, row, now)


@router.get("", dependencies=[requires("read", narrowed)])
def list_projects(
    session: ReadSession, now: Now, who: CallerDep, cursor: Cursor = None, limit: PageSize = 100
) -> Page[Project]:
    where = [] if who.project is None else [ProjectRow.id == who.project]
    rows, after = page(session, ProjectRow, where, (ProjectRow.created_at, ProjectRow.id), cursor, limit)
    return Page(items=[projects.describe(session, row, now) for row in rows], next=after)


@router.get("/{project_id}", dependencies=[requires("read", by_path)])
def show_project(project_id: UUID, session: ReadSession, now: Now) -> Project:
    return projects.describe(session, projects.find(session, project_id), now)


@router.patch("/{project_id}", responses=refuses(PrivilegedStrategy), dependencies=[requires("admin", by_path)])
def change_project(project_id: UUID, patch: ProjectPatch, session: WriteSession, now: Now) -> Project:
    return projects.describe(session, projects.change(session, project_id, patch, now), now)
