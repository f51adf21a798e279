"""What handlers are given: sessions, stores, the clock, and who is asking."""

from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from ipaddress import ip_address
from typing import Annotated

from fastapi import Depends, Query, Request, Security
from fastapi.concurrency import run_in_threadpool
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from sqlalchemy.orm import Session

from api_schemas.keys import Key, Scope
from service import keys, origin
from service.errors import NotAllowed, Unauthenticated
from service.scorings import Limits, limits_of
from service.settings import Settings
from service.store.blobs import Blobs
from service.store.database import Database
from service.store.provenance import ProvenanceBlobs


@dataclass(frozen=True)
class Services:
    """Everything that an API process holds open."""

    settings: Settings
    database: Database
    blobs: Blobs
    provenance: ProvenanceBlobs | None
    clock: Callable[[], datetime]

    @property
    def limits(self) -> Limits:
        """Bounds of scorings."""
        return limits_of(self.settings)


LOCAL = "local"  # who asks without a key, in embedded mode


# What only hands something on is `async`: a plain function would cost a trip through the thread pool each.
async def services(request: Request) -> Services:
    """The process's services."""
    held: Services = request.app.state.services
    return held


ServicesDep = Annotated[Services, Depends(services)]


def _write_session(held: ServicesDep) -> Iterator[Session]:
    with held.database.write() as session:
        yield session


def _read_session(held: ServicesDep) -> Iterator[Session]:
    with held.database.read() as session:
        yield session


async def _now(held: ServicesDep) -> datetime:
    return held.clock()


# The scope "function" ends the dependency, and so commits, before the answer is sent: no label is acknowledged that a
# crash could still lose.
WriteSession = Annotated[Session, Depends(_write_session, scope="function")]
ReadSession = Annotated[Session, Depends(_read_session, scope="function")]
Now = Annotated[datetime, Depends(_now)]
Cursor = Annotated[str | None, Query(description="`next` of the page before")]
PageSize = Annotated[int, Query(ge=1, le=1000)]

_bearer = HTTPBearer(auto_error=False, description="an API key; embedded mode needs none from this machine")
Credentials = Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]


def requires(scope: Scope) -> Callable[[Request, Services, Credentials], Awaitable[None]]:
    """A dependency that lets in keys with this scope, and in embedded mode anybody on this machine without a key."""

    async def check(request: Request, held: ServicesDep, credentials: Credentials) -> None:
        if credentials is None:
            if held.settings.embedded and _is_loopback(request):
                _name_caller(request, LOCAL, LOCAL)
                return
            raise Unauthenticated("authorization: send an API key as `Authorization: Bearer KEY`")
        key = await run_in_threadpool(_verified, held, credentials.credentials)
        if scope not in key.scopes and "admin" not in key.scopes:
            raise NotAllowed(f"authorization: this needs the scope {scope!r}, the key has {', '.join(key.scopes)}")
        _name_caller(request, str(key.id), f"key {key.id} {key.name}")

    return check


def _name_caller(request: Request, caller: str, actor: str) -> None:
    """Who this is, for idempotency keys, which are each caller's own, and for events and logs."""
    request.state.caller = caller
    origin.bind_actor(actor[:200])


def _verified(held: Services, secret: str) -> Key:
    with held.database.read() as session:
        return keys.verify(session, secret)


def _is_loopback(request: Request) -> bool:
    host = request.client.host if request.client else ""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False
