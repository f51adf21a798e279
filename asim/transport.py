"""One HTTP exchange: retries where they are harmless, problem details as exceptions."""

import random
import time
from collections.abc import Callable, Collection, Mapping
from typing import BinaryIO

import httpx
from pydantic import BaseModel, ValidationError

from api_schemas.errors import Problem
from asim.errors import ServiceError, Unreachable, service_error

RETRIED_STATUSES = frozenset({429, 502, 503, 504})
LONGEST_PAUSE = 10.0  # seconds
IDEMPOTENCY_KEY = "Idempotency-Key"  # what is sent again under the same one is done once
LOOPBACK = ("127.0.0.1", "localhost", "::1")
Params = Mapping[str, object]
Upload = tuple[str, tuple[str, bytes | BinaryIO, str]]


class Transport:
    """Sends requests to one service.

    A GET, or a request with an Idempotency-Key, is repeated after a broken connection or a "not now" (429, 502, 503,
    504), waiting as long as Retry-After says. Any other request is repeated only where no connection was made, so that
    nothing is ever done twice.
    """

    def __init__(
        self,
        base_url: str,
        key: str | None,
        timeout: float,
        transport: httpx.BaseTransport | None,
        *,
        retries: int = 5,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        remote = httpx.URL(base_url).host not in LOOPBACK  # a proxy of the environment has no business on this machine
        self._http = httpx.Client(
            base_url=base_url, headers=headers, timeout=timeout, transport=transport, trust_env=remote
        )
        self._retries = retries
        self._sleep = sleep
        self._random = random.Random()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def request(
        self,
        method: str,
        path: str,
        *,
        params: Params | None = None,
        body: BaseModel | None = None,
        files: list[Upload] | None = None,
        headers: Mapping[str, str] | None = None,
        accept: Collection[int] = (),
    ) -> httpx.Response:
        """The answer to one request; statuses in `accept` are answers too, other 4xx and 5xx raise.

        Raises:
            ServiceError: the service refused.
            Unreachable: no answer came.
        """
        request = self._build(method, path, params, body, files)
        request.headers.update(headers or {})
        attempt = 0
        while True:
            outcome = self._attempt(request)
            if isinstance(outcome, httpx.Response) and (outcome.is_success or outcome.status_code in accept):
                return outcome
            if attempt >= self._retries or not _may_repeat(request, outcome):
                raise _failure(outcome, request)
            self._sleep(self._pause(attempt, outcome))
            attempt += 1

    def _build(
        self, method: str, path: str, params: Params | None, body: BaseModel | None, files: list[Upload] | None
    ) -> httpx.Request:
        sent = {name: str(value) for name, value in (params or {}).items() if value is not None}
        if body is None:
            return self._http.build_request(method, path, params=sent, files=files)
        headers = {"Content-Type": "application/json"}
        content = body.model_dump_json(exclude_unset=method == "PATCH")  # what a patch leaves out stays as it is
        return self._http.build_request(method, path, params=sent, content=content, headers=headers)

    def _attempt(self, request: httpx.Request) -> httpx.Response | httpx.TransportError:
        try:
            return self._http.send(request)
        except httpx.TransportError as error:
            return error

    def _pause(self, attempt: int, outcome: httpx.Response | httpx.TransportError) -> float:
        """Seconds before the next attempt: what the service asked for, else 0.2 s doubling, with jitter."""
        asked = outcome.headers.get("Retry-After", "") if isinstance(outcome, httpx.Response) else ""
        base = float(asked) if asked.isdigit() else 0.2 * 2**attempt
        return min(base, LONGEST_PAUSE) * self._random.uniform(1.0, 1.25)


def _may_repeat(request: httpx.Request, outcome: httpx.Response | httpx.TransportError) -> bool:
    if isinstance(outcome, httpx.ConnectError | httpx.ConnectTimeout):
        return True
    if request.method != "GET" and IDEMPOTENCY_KEY not in request.headers:
        return False
    return isinstance(outcome, httpx.TransportError) or outcome.status_code in RETRIED_STATUSES


def _failure(outcome: httpx.Response | httpx.TransportError, request: httpx.Request) -> ServiceError | Unreachable:
    if isinstance(outcome, httpx.Response):
        return service_error(_problem(outcome))
    reason = str(outcome) or type(outcome).__name__
    service = f"{request.url.scheme}://{request.url.netloc.decode()}"
    asked = f"{request.method} {request.url.path}"
    return Unreachable(f"no answer from {service} to {asked}: {reason}; does `asim serve` run there?")


def _problem(answer: httpx.Response) -> Problem:
    try:
        return Problem.model_validate_json(answer.content)
    except ValidationError:  # a proxy, or another program on the port: it does not speak problem details
        detail = f"the service answered {answer.status_code} {answer.reason_phrase} without saying why"
        return Problem(type="about:blank", title=answer.reason_phrase, status=answer.status_code, detail=detail)
