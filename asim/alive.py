"""Whether what should run on this machine does: the health check of containers, which have a host name each."""

import socket
from datetime import datetime

import httpx

from service import canary
from service.store.database import Database
from service.store.queries import jobs as queries

ANSWER_SECONDS = 4.0


def api_answers(url: str) -> bool:
    """True where the API says that it lives."""
    try:
        return httpx.get(f"{url}/health/live", timeout=ANSWER_SECONDS, trust_env=False).status_code == 200
    except httpx.HTTPError:
        return False


def heard_of(database: Database, now: datetime) -> bool:
    """True where a worker or scheduler of this machine said lately that it is there."""
    with database.read() as session:
        return queries.heard_from_host(session, socket.gethostname(), now - canary.WORKER_SILENCE)
