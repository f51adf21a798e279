"""API keys: the service keeps only the hash of a secret."""

import hashlib
import hmac
import secrets
from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy.orm import Session

from api_schemas.keys import Key, KeyCreate, KeyCreated
from service import events
from service.errors import Unauthenticated, UnknownResource
from service.store.tables import KeyRow


def create(session: Session, request: KeyCreate, now: datetime) -> KeyCreated:
    """A new key; the answer is the only place that ever holds its secret."""
    key_id = uuid4()
    secret = f"asim_{key_id.hex}_{secrets.token_urlsafe(32)}"
    row = KeyRow(
        id=key_id,
        name=request.name,
        secret_sha256=_hash(secret),
        scopes=list(request.scopes),
        created_at=now,
    )
    session.add(row)
    events.record(session, None, "key.created", {"key": str(key_id), "name": request.name}, now)
    return KeyCreated(secret=secret, **describe(row).model_dump())


def revoke(session: Session, key_id: UUID, now: datetime) -> None:
    """Delete a key. Raises UnknownResource."""
    row = session.get(KeyRow, key_id)
    if row is None:
        raise UnknownResource("key", key_id)
    session.delete(row)
    events.record(session, None, "key.revoked", {"key": str(key_id)}, now)


def verify(session: Session, secret: str) -> Key:
    """The key of a secret, compared in constant time. Raises Unauthenticated."""
    parts = secret.split("_", 2)
    try:
        row = session.get(KeyRow, UUID(hex=parts[1])) if len(parts) == 3 else None
    except ValueError:
        row = None
    if row is None or not hmac.compare_digest(row.secret_sha256, _hash(secret)):
        raise Unauthenticated("authorization: this API key is not known or was revoked")
    return describe(row)


def describe(row: KeyRow) -> Key:
    """The key as the API shows it."""
    return Key.model_validate(
        {
            "id": row.id,
            "name": row.name,
            "scopes": row.scopes,
            "created_at": row.created_at,
        }
    )


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
