"""Who calls, what was answered, and what happened."""

from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import BigInteger, ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from service.store.columns import Row
from service.store.horizon import CurrentTransaction


class EventRow(Row):
    """Something that happened: who, when, what. `transaction` tells readers what may still be committed before it."""

    __tablename__ = "event"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    project_id: Mapped[UUID | None]
    kind: Mapped[str] = mapped_column(String(60))
    data: Mapped[dict[str, object]]
    actor: Mapped[str] = mapped_column(String(200), default="")
    correlation: Mapped[str] = mapped_column(String(100), default="")
    transaction: Mapped[int] = mapped_column(BigInteger, default=CurrentTransaction())
    created_at: Mapped[datetime]
    __table_args__ = (
        Index("ix_event_project", "project_id", "transaction", "id"),
        Index("ix_event_order", "transaction", "id"),
    )


class EventEpochRow(Row):
    """One row: `added` to the numbers of the database server's transactions, which another server counts anew."""

    __tablename__ = "event_epoch"
    id: Mapped[int] = mapped_column(primary_key=True)
    added: Mapped[int] = mapped_column(BigInteger)


class IdempotencyRow(Row):
    """The answer to a request that carried an Idempotency-Key, kept so that a repetition gets the same one.

    It is written in the transaction of what the request did: both are there, or neither.
    """

    __tablename__ = "idempotency"
    caller: Mapped[str] = mapped_column(String(40), primary_key=True)
    route: Mapped[str] = mapped_column(String(40), primary_key=True)
    key: Mapped[str] = mapped_column(String(200), primary_key=True)
    request_sha256: Mapped[str] = mapped_column(String(64))
    status: Mapped[int | None]
    location: Mapped[str | None] = mapped_column(String(200))
    body: Mapped[str | None]
    expires_at: Mapped[datetime] = mapped_column(index=True)


class KeyRow(Row):
    """An API key: the hash of its secret and what it may do, in one project or all, until when."""

    __tablename__ = "api_key"
    id: Mapped[UUID] = mapped_column(primary_key=True, default=uuid4)
    name: Mapped[str] = mapped_column(String(200))
    secret_sha256: Mapped[str] = mapped_column(String(64))
    scopes: Mapped[list[object]]
    project_id: Mapped[UUID | None] = mapped_column(ForeignKey("project.id"))
    expires_at: Mapped[datetime | None]
    created_at: Mapped[datetime]
