"""What handlers are given: sessions, stores, the clock. Who is asking: service.api.access."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Annotated

from fastapi import Depends, Query, Request
from sqlalchemy.orm import Session

from service.api.requests import Answered
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
    answered: Answered = field(default_factory=Answered)

    @property
    def limits(self) -> Limits:
        """Bounds of scorings."""
        return limits_of(self.settings)


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
