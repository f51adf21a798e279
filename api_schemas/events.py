"""Events: what happened in a project, in order."""

from uuid import UUID

from api_schemas.base import Schema, Timestamp


class Event(Schema):
    """`id` grows by commit within a project; `data` depends on `kind`."""

    id: int
    project: UUID | None
    kind: str
    data: dict[str, object]
    created_at: Timestamp
