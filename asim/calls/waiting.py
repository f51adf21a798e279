"""Waiting for what the service has not done yet."""

import time
from collections.abc import Callable
from typing import TypeVar

from api_schemas.jobs import Job
from asim.errors import JobCancelled, JobFailed, NotReady

Item = TypeVar("Item")
POLL_SECONDS = 0.2


def is_done(job: Job) -> bool:
    """Whether it is. Raises JobFailed for a job that will never be, JobCancelled where somebody stopped it."""
    if job.state in ("failed", "cancelled"):
        raise JobCancelled(job) if job.state == "cancelled" else JobFailed(job)
    return job.state == "done"


def poll(ask: Callable[[], Item], done: Callable[[Item], bool], timeout: float | None, what: str) -> Item:
    """Ask until it is done. Raises NotReady after `timeout` seconds."""
    deadline = None if timeout is None else time.monotonic() + timeout
    while True:
        seen = ask()
        if done(seen):
            return seen
        if deadline is not None and time.monotonic() >= deadline:
            raise NotReady(f"{what} was not done after {timeout:g} s")
        time.sleep(POLL_SECONDS)
