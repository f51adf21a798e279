"""/jobs and /events."""

from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Query

from api_schemas.base import Page
from api_schemas.events import Event
from api_schemas.jobs import Job
from service import cancellation, events, jobs, projects
from service.api.access import By, CallerDep, by_query, narrowed, requires
from service.api.dependencies import Cursor, Now, PageSize, ReadSession, WriteSession
from service.api.description import refuses
from service.errors import UnknownResource
from service.jobs import JobFinished
from service.store.queries.events import ORDER, settled
from service.store.queries.listing import page
from service.store.tables import EventRow, JobRow

router = APIRouter(tags=["jobs"])
by_job = By(JobRow, "job")


@router.get("/jobs", dependencies=[requires("read", by_query)])
def list_jobs(project: UUID, session: ReadSession, cursor: Cursor = None, limit: PageSize = 100) -> Page[Job]:
    projects.find(session, project)
    rows, after = page(
        session,
        JobRow,
        [JobRow.project_id == project],
        (JobRow.created_at, JobRow.id),
        cursor,
        limit,
        newest_first=True,
    )
    return Page(items=[jobs.describe(row) for row in rows], next=after)


@router.get("/jobs/{job_id}", dependencies=[requires("read", by_job)])
def show_job(job_id: UUID, session: ReadSession) -> Job:
    return jobs.describe(jobs.find(session, job_id))


@router.delete("/jobs/{job_id}", responses=refuses(JobFinished), dependencies=[requires("admin", by_job)])
def cancel_job(job_id: UUID, session: WriteSession, now: Now) -> Job:
    return jobs.describe(cancellation.cancel(session, job_id, now))


@router.get("/events", dependencies=[requires("read", narrowed)])
def list_events(
    session: ReadSession,
    who: CallerDep,
    project: UUID | None = None,
    newest: Annotated[bool, Query(description="newest first")] = False,
    cursor: Cursor = None,
    limit: PageSize = 100,
) -> Page[Event]:
    if who.project is not None and project not in (None, who.project):
        raise UnknownResource("project", project)
    project = project or who.project
    if project is not None:
        projects.find(session, project)
    where = [] if newest else [settled()]
    where += [] if project is None else [EventRow.project_id == project]
    rows, after = page(session, EventRow, where, ORDER, cursor, limit, newest_first=newest)
    return Page(items=[events.describe(row) for row in rows], next=after)
