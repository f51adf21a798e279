"""API keys: the service keeps only the hash of a secret."""

import hashlib
import hmac
import secrets
from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import or_, select
from sqlalchemy.orm import Session

from api_schemas.keys import Key, KeyCreate, KeyCreated
from service import events, projects
from service.errors import InvalidField, ServiceError, UnknownResource
from service.store.tables import KeyRow


class Unauthenticated(ServiceError):
    """A valid API key is needed."""

    status_code = 401
    headers = {"WWW-Authenticate": "Bearer"}


def create(session: Session, request: KeyCreate, now: datetime) -> KeyCreated:
    """A new key; the answer is the only place that ever holds its secret. Raises UnknownResource, InvalidField."""
    if request.project is not None:
        projects.find(session, request.project)
    if request.expires_at is not None and request.expires_at <= now:
        raise InvalidField("expires_at", request.expires_at.isoformat(), "must be in the future")
    key_id = uuid4()
    secret = f"asim_{key_id.hex}_{secrets.token_urlsafe(32)}"
    row = KeyRow(
        id=key_id,
        name=request.name,
        secret_sha256=_hash(secret),
        scopes=list(dict.fromkeys(request.scopes)),
        project_id=request.project,
        expires_at=request.expires_at,
        created_at=now,
    )
    session.add(row)
    told: dict[str, object] = {"key": str(key_id), "name": request.name, "scopes": row.scopes}
    events.record(session, request.project, "key.created", told, now)
    return KeyCreated(secret=secret, **describe(row).model_dump())


def revoke(session: Session, key_id: UUID, now: datetime) -> None:
    """Delete a key. Raises UnknownResource."""
    row = session.get(KeyRow, key_id)
    if row is None:
        raise UnknownResource("key", key_id)
    session.delete(row)
    events.record(session, row.project_id, "key.revoked", {"key": str(key_id), "name": row.name}, now)


def verify(session: Session, secret: str, now: datetime) -> Key:
    """The key of a secret, compared in constant time. Raises Unauthenticated."""
    named = named_by(secret)
    row = None if named is None else session.get(KeyRow, named)
    if row is None or not hmac.compare_digest(row.secret_sha256, _hash(secret)):
        raise Unauthenticated("authorization: this API key is not known or was revoked")
    if row.expires_at is not None and row.expires_at <= now:
        raise Unauthenticated(f"authorization: this API key expired at {row.expires_at.isoformat()}")
    return describe(row)


def named_by(secret: str) -> UUID | None:
    """The id of the key that a secret claims to be of."""
    parts = secret.split("_", 2)
    try:
        return UUID(hex=parts[1]) if len(parts) == 3 else None
    except ValueError:
        return None


def everyone(session: Session) -> list[Key]:
    """All keys, the oldest first."""
    return [describe(row) for row in session.scalars(select(KeyRow).order_by(KeyRow.created_at, KeyRow.id))]


def usable(session: Session, now: datetime) -> bool:
    """True where there is a key that has not expired."""
    unexpired = or_(KeyRow.expires_at.is_(None), KeyRow.expires_at > now)
    return session.scalar(select(KeyRow.id).where(unexpired).limit(1)) is not None


def describe(row: KeyRow) -> Key:
    """The key as the API shows it."""
    return Key.model_validate(
        {
            "id": row.id,
            "name": row.name,
            "scopes": row.scopes,
            "project": row.project_id,
            "expires_at": row.expires_at,
            "created_at": row.created_at,
        }
    )


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
