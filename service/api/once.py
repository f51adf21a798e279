"""Requests that may be sent twice: `Idempotency-Key`, and answers that wait: `Prefer: wait=N`."""

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Annotated

from fastapi import Header, Request, Response
from sqlalchemy.orm import Session

from api_schemas.base import Schema
from service import idempotency
from service.api.access import Caller
from service.errors import InvalidField
from service.idempotency import KeyUse
from service.settings import Settings
from service.store.tables import IdempotencyRow

LONGEST_WAIT = 30.0  # seconds that an answer is held back at most
IdempotencyKey = Annotated[
    str | None,
    Header(
        json_schema_extra={"minLength": 1, "maxLength": 200, "pattern": "^[ -~]*$"},
        description="any text of 1 to 200 printable characters; the same request under the same key is done once and "
        "answered alike, for a week by default (ASIM_IDEMPOTENCY_HOURS)",
    ),
]
Prefer = Annotated[str | None, Header(description="`wait=20` holds a 202 for up to 20 seconds, 30 at most")]


@dataclass(frozen=True)
class Answer:
    """What a handler answers, before it is a response."""

    status: int
    body: str
    location: str | None = None
    headers: dict[str, str] = field(default_factory=dict)

    def response(self) -> Response:
        """As it goes out."""
        headers = self.headers | ({"Location": self.location} if self.location else {})
        return Response(self.body, self.status, headers, media_type="application/json")


def key_use(request: Request, who: Caller, key: str | None, body: Schema) -> KeyUse | None:
    """What this request's key stands for; None without a key. Raises InvalidField."""
    if key is None:
        return None
    if not re.fullmatch(r"[\x20-\x7e]{1,200}", key):
        raise InvalidField("Idempotency-Key", key, "must be 1 to 200 printable ASCII characters")
    digest = hashlib.sha256(body.model_dump_json().encode()).hexdigest()
    return KeyUse(who.name, f"{request.method} {request.url.path}", key, digest)


def kept_answer(session: Session, use: KeyUse | None, now: datetime) -> Answer | None:
    """The answer that is kept for this key, if any: for who would do much before the rule. Changes nothing."""
    kept = None if use is None else idempotency.find(session, use, now)
    return None if kept is None else _replay(kept)


def answered_once(
    session: Session, use: KeyUse | None, settings: Settings, now: datetime, rule: Callable[[], Answer]
) -> Answer:
    """The answer that is kept for this key, or the rule's; a 202 has nothing to keep, it is asked again."""
    if use is None:
        return rule()
    kept = idempotency.begin(session, use, now, timedelta(hours=settings.idempotency_hours))
    replay = _replay(kept)
    if replay is not None:
        return replay
    answer = rule()
    if answer.status == 202:
        idempotency.forget(session, kept)
    else:
        idempotency.finish(kept, answer.status, answer.location, answer.body)
    return answer


def wait_seconds(prefer: str | None) -> float:
    """Of a Prefer header; 0 where it does not ask to wait. Preferences are wishes: what is not understood is left."""
    found = re.search(r"(?:^|[,;\s])wait\s*=\s*\"?(\d{1,6})", prefer or "", re.IGNORECASE)
    return min(float(found[1]), LONGEST_WAIT) if found else 0.0


def _replay(kept: IdempotencyRow) -> Answer | None:
    """None where the request is still to be done."""
    if kept.status is None:
        return None
    return Answer(kept.status, kept.body or "", kept.location, {"Idempotency-Replayed": "true"})
