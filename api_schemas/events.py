"""Events: what happened in a project, in order."""

from uuid import UUID

from api_schemas.base import Schema, Timestamp


class Event(Schema):
    """One state change. Listed oldest first they can be followed: one that is shown has all before it.

    actor: who did it: the name of an API key, "local" in embedded mode, a worker, the reaper.
    correlation: the `X-Correlation-ID` of the request that it goes back to. `data` depends on `kind`.
    """

    id: int
    project: UUID | None
    kind: str
    data: dict[str, object]
    actor: str
    correlation: str
    created_at: Timestamp
