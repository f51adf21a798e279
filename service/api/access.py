"""Who asks, and what they may reach: by scope, and by project where the key is of one project.

A key of one project fails closed: it reaches only endpoints that say how the project of a request is known.
"""

from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Depends, Request, Security
from fastapi.concurrency import run_in_threadpool
from fastapi.routing import APIRoute
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from sqlalchemy import select

from api_schemas.keys import Key, Scope
from service.api.dependencies import Services, ServicesDep
from service.errors import InvalidField, ServiceError, UnknownResource
from service.keys import Unauthenticated
from service.store.tables import AcquisitionRow, JobRow, ModelVersionRow, RoundRow

LONGEST_ACTOR = 200
NO_KEY = "authorization: send an API key as `Authorization: Bearer KEY`"
_bearer = HTTPBearer(auto_error=False, description="an API key; embedded mode needs none from this machine")
Credentials = Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]
OfOneProject = type[AcquisitionRow] | type[JobRow] | type[ModelVersionRow] | type[RoundRow]


class NotAllowed(ServiceError):
    """The key does not allow this."""

    status_code = 403


@dataclass(frozen=True)
class Caller:
    """name: under which idempotency keys are the caller's own. actor: who it is in events and logs.

    project: the only one that the caller reaches; None for all.
    """

    name: str
    actor: str
    scopes: tuple[Scope, ...]
    project: UUID | None = None

    @staticmethod
    def of(key: Key) -> "Caller":
        """Who shows this key."""
        return Caller(str(key.id), f"key {key.id} {key.name}"[:LONGEST_ACTOR], tuple(key.scopes), key.project)


ON_THIS_MACHINE = Caller("local", "local", ("admin",))  # who asks without a key, in embedded mode


async def caller(request: Request) -> Caller:
    """Who asks, as the guard found out before the body was read. Raises Unauthenticated."""
    found: Caller | None = getattr(request.state, "caller", None)
    if found is None:
        raise Unauthenticated(NO_KEY)
    return found


CallerDep = Annotated[Caller, Depends(caller)]
Reach = Callable[[Request, Services, UUID], Awaitable[None]]  # raises where a request is not about this project


@dataclass(frozen=True)
class Requires:
    """A dependency that lets in callers with this scope. reach None: but those whose key is of one project."""

    scope: Scope
    reach: Reach | None = None

    async def __call__(self, request: Request, held: ServicesDep, who: CallerDep, _: Credentials) -> None:
        self.check(who)
        if who.project is not None and self.reach is not None:
            await self.reach(request, held, who.project)

    def check(self, who: Caller) -> None:
        """What is known without the request. Raises NotAllowed."""
        if self.scope not in who.scopes and "admin" not in who.scopes:
            lacks = f"this needs the scope {self.scope!r}, the key has {', '.join(who.scopes)}"
            raise NotAllowed(f"authorization: {lacks}")
        if who.project is not None and self.reach is None:
            raise NotAllowed(f"authorization: this is about all projects, the key reaches {who.project} only")


class AccessTable:
    """What each route requires, to be asked before a body is read: dependencies come after it."""

    def __init__(self, routers: Iterable[APIRouter]) -> None:
        self._routes = [
            (route.path_regex, route.methods or set(), each.dependency)
            for router in routers
            for route in router.routes
            if isinstance(route, APIRoute)
            for each in route.dependencies
            if isinstance(each.dependency, Requires)
        ]

    def check(self, request: Request) -> None:
        """Of a request whose caller is known. Raises NotAllowed."""
        who: Caller | None = getattr(request.state, "caller", None)
        for pattern, methods, required in self._routes:
            if who is not None and request.method in methods and pattern.match(request.url.path):
                required.check(who)


def requires(scope: Scope, reach: Reach | None = None) -> Any:
    """`Requires` as a route declares it."""
    return Depends(Requires(scope, reach))


async def by_query(request: Request, _: Services, project: UUID) -> None:
    """The project stands in the query."""
    _expect(request.query_params.get("project"), project)


async def by_body(request: Request, _: Services, project: UUID) -> None:
    """The project stands in the JSON body, which FastAPI has read and kept by now."""
    try:
        body = await request.json()
    except ValueError:  # there is none
        body = None
    _expect(body.get("project") if isinstance(body, dict) else None, project)


async def by_path(request: Request, _: Services, project: UUID) -> None:
    """The project stands in the path."""
    _expect(request.path_params["project_id"], project)


async def narrowed(request: Request, held: Services, project: UUID) -> None:
    """The handler looks at `Caller.project` itself and tells of that project only."""


@dataclass(frozen=True)
class By:
    """The path names a thing of one project. What is another project's is as unknown as what is not there."""

    row: OfOneProject
    noun: str

    async def __call__(self, request: Request, held: Services, project: UUID) -> None:
        name = request.path_params[f"{self.noun}_id"]
        if await run_in_threadpool(self._owner, held, name) != project:
            raise UnknownResource(self.noun, name)

    def _owner(self, held: Services, name: str) -> UUID | None:
        try:
            key = UUID(name)
        except ValueError:
            return None
        with held.database.read() as session:
            return session.scalar(select(self.row.project_id).where(self.row.id == key))


def _expect(named: object, project: UUID) -> None:
    try:
        found = UUID(str(named))
    except ValueError:
        raise InvalidField("project", named, f"must be {project}, the only one that this key reaches") from None
    if found != project:
        raise UnknownResource("project", found)
