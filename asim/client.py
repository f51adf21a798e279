"""The SDK: one method an endpoint, typed answers, refusals as exceptions."""

import httpx

from asim.calls.jobs import JobCalls
from asim.calls.labels import LabelCalls
from asim.calls.policies import PolicyCalls
from asim.calls.projects import ProjectCalls
from asim.calls.rounds import RoundCalls
from asim.transport import Transport


class Client(ProjectCalls, PolicyCalls, LabelCalls, RoundCalls, JobCalls):
    """Speaks to one service. Use it as a context manager, or call `close`.

    Args:
        base_url: where the service listens, as `asim serve` prints it.
        key: an API key; embedded mode needs none.
        timeout: seconds without a byte after which a request counts as lost.
        transport: an httpx transport, for tests.
        retries: how often a request is sent again: a GET, `acquire` and `label`, which carry an Idempotency-Key, and
            whatever found no connection.

    Every method raises asim.errors.ServiceError (or its subclass for the status) where the service refuses, and
    asim.errors.Unreachable where no answer comes.
    """

    def __init__(
        self,
        base_url: str,
        key: str | None = None,
        timeout: float = 60.0,
        transport: httpx.BaseTransport | None = None,
        *,
        retries: int = 5,
    ) -> None:
        self.base_url = base_url.rstrip("/")
        super().__init__(Transport(self.base_url, key, timeout, transport, retries=retries), timeout)
