"""API keys. The secret is shown once, at creation; the service keeps its hash."""

from typing import Literal
from uuid import UUID

from pydantic import Field

from api_schemas.base import Schema, Timestamp

Scope = Literal["admin", "acquire", "label", "read"]


class KeyCreate(Schema):
    """What the holder may do; `admin` is everything, within the project where one is named."""

    name: str = Field(min_length=1, max_length=200)
    scopes: list[Scope] = Field(min_length=1, max_length=4)
    project: UUID | None = Field(default=None, description="the only project that the key reaches; null for all")
    expires_at: Timestamp | None = Field(default=None, description="from then on the key opens nothing; null for never")


class Key(Schema):
    """A key without its secret."""

    id: UUID
    name: str
    scopes: list[Scope]
    project: UUID | None
    expires_at: Timestamp | None
    created_at: Timestamp


class KeyCreated(Key):
    """`secret` goes into `Authorization: Bearer <secret>` and is never shown again."""

    secret: str


class Health(Schema):
    """State of the parts that the service needs.

    canaries: by queue, seconds since a job that does nothing was last done; None where none was yet. A queue is served
    while that is recent, or while one of its workers is at work on a job.
    """

    status: Literal["ok", "unavailable"]
    database: bool
    blobs: bool
    workers_alive: int
    canaries: dict[str, float | None]
    version: str
