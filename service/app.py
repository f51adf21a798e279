"""The API: an application factory, for uvicorn and for tests."""

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import datetime
from importlib.metadata import version

import structlog
from fastapi import FastAPI

from service import traces
from service.allocator import keep_freed_memory
from service.api import (
    acquisitions,
    description,
    jobs,
    labels,
    policies,
    problems,
    projects,
    rounds,
    security,
    system,
    trajectories,
)
from service.api.dependencies import Services
from service.carrier import Relay
from service.clock import utc_now
from service.collector import freeze_imports
from service.dashboard import page
from service.log import configure_logs
from service.settings import Settings
from service.store.blobs import Blobs
from service.store.database import migrate, open_database
from service.store.provenance import open_provenance


def create_app(settings: Settings | None = None, clock: Callable[[], datetime] = utc_now) -> FastAPI:
    """The service on its stores. Embedded mode brings its own schema up to date; elsewhere the command line does."""
    settings = settings or Settings()
    if (
        not structlog.is_configured()
    ):  # started by uvicorn itself; structlog's own console takes seconds for a traceback
        configure_logs()
    app = FastAPI(
        title="ASIM",
        version=version("asim"),
        summary="Active learning for robot world models: which few segments of your action-free data to label next.",
        lifespan=_lifespan,
        telemetry={
            "tracer_provider": traces.provider(settings.traces_url),
            "tracing": bool(settings.traces_url),
            "operation_spans": False,
            "metrics": False,  # /metrics has them
            "logs": False,  # service.log writes them
        },
        docs_url=None,  # FastAPI's pages load their scripts from another host
        redoc_url=None,
    )
    app.state.services = open_services(settings, clock)
    description.install(app)
    problems.install(app)
    modules = (projects, trajectories, policies, acquisitions, labels, rounds, jobs, system)
    routers = [module.router for module in modules]
    security.install(app, app.state.services, routers)
    for router in routers:
        app.include_router(router)
    app.include_router(page.router)
    return app


def open_services(settings: Settings, clock: Callable[[], datetime] = utc_now) -> Services:
    """Open database and stores; in embedded mode they are made where they are missing."""
    url = settings.resolved_database_url()
    if settings.embedded:
        settings.make_data_folder()
        migrate(url)
    return Services(
        settings=settings,
        database=open_database(url, settings.pool_size),
        blobs=Blobs(settings.resolved_blobs_url()),
        provenance=open_provenance(settings),
        clock=clock,
    )


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    held: Services = app.state.services
    freeze_imports()
    keep_freed_memory()
    relay = (
        None if held.settings.embedded or not held.settings.relay else Relay(held.database, held.settings, held.clock)
    )
    if relay:
        relay.start()
    yield
    if relay:
        relay.stop()
    held.database.close()
