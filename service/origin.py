"""Who acts, and on whose request: bound around an action, named by its events and by all its log lines."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import structlog


@dataclass(frozen=True)
class Origin:
    """actor: an API key, a worker, the reaper. correlation: the id of the request that all of it goes back to."""

    actor: str = ""
    correlation: str = ""


def current() -> Origin:
    """What is bound here; empty where nothing is."""
    bound_now = structlog.contextvars.get_contextvars()
    return Origin(bound_now.get("actor", ""), bound_now.get("correlation", ""))


@contextmanager
def bound(actor: str | None = None, correlation: str | None = None) -> Iterator[None]:
    """Bind for the time of the block, in this thread or task; None leaves what is bound."""
    given = {name: value for name, value in (("actor", actor), ("correlation", correlation)) if value is not None}
    with structlog.contextvars.bound_contextvars(**given):
        yield


def bind_actor(actor: str) -> None:
    """Name the actor once it is known, for what is left of the block that `bound` opened."""
    structlog.contextvars.bind_contextvars(actor=actor)
