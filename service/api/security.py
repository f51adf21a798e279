"""Before any handler: who asks, what a browser may do, how large a body may be, and which request this is.

Browsers may use pages of this service's own host only, under this host's names only. Nobody's body is read before it
is known that they may send one.
"""

import re
import time
from collections.abc import Iterable
from http import HTTPStatus
from ipaddress import ip_address
from uuid import uuid4

from fastapi import APIRouter, FastAPI, HTTPException, Request
from fastapi.concurrency import run_in_threadpool
from limits import RateLimitItemPerMinute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import keys, origin, traces
from service.api import problems
from service.api.access import NO_KEY, ON_THIS_MACHINE, AccessTable, Caller
from service.api.attempts import FailedKeys
from service.api.dependencies import Services
from service.api.headers import CORRELATION, HEADERS
from service.api.problems import BodyTooLarge
from service.errors import ServiceError
from service.keys import Unauthenticated
from service.settings import Settings

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
PUBLIC = frozenset({"/", "/dashboard", "/openapi.json", "/health/live", "/health/ready"})
PUBLIC_FOLDER = "/dashboard/"
DATA_PATH = "/trajectories"
MOST_VALUES, MOST_CONTAINERS = 8_000_000, 1_000_000  # of a JSON body: a list of three bytes takes 64
FORWARDED = (  # a proxy of this machine speaks for somebody elsewhere
    "forwarded",
    "via",
    "x-forwarded-for",
    "x-forwarded-host",
    "x-forwarded-proto",
    "x-real-ip",
)


class CrossOrigin(ServiceError):
    """The request comes from another site's page."""

    status_code = 403


def install(app: FastAPI, services: Services, routers: Iterable[APIRouter]) -> None:
    """Refuse foreign Host headers (DNS rebinding), cross-origin writes, strangers and bodies over the limit."""
    app.add_middleware(Guard, services=services, access=AccessTable(routers))


class Timed:
    """A send that knows which status went out; 0 where none did."""

    def __init__(self, send: Send) -> None:
        self._send, self.status = send, 0

    async def __call__(self, message: Message) -> None:
        self.status = message.get("status", self.status)
        await self._send(message)


class Guard:
    """The middleware; plain ASGI, because Starlette's base class copies every request through a task of its own."""

    def __init__(self, app: ASGIApp, services: Services, access: AccessTable) -> None:
        self._app, self._services, self._access = app, services, access
        asked = services.settings
        self._failed = FailedKeys(
            per_address=RateLimitItemPerMinute(asked.failed_keys_per_minute),
            per_key=RateLimitItemPerMinute(asked.failures_per_key),  # a forgotten script does not lock out its machine
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        correlation = request.state.correlation = _correlation(request)
        traces.note(traces.CORRELATION, correlation)
        with origin.bound(actor="", correlation=correlation):
            named = _with_headers(send, HEADERS | {CORRELATION: correlation})
            timed, began = Timed(named), time.monotonic()
            try:
                await self._guarded(request, receive, timed)
            except Exception:  # answered outside of this, with 500, and logged there
                timed.status = 500
                raise
            finally:
                if timed.status:  # else who asked has gone
                    self._services.answered.tell(request, timed.status, time.monotonic() - began)

    async def _guarded(self, request: Request, receive: Receive, send: Send) -> None:
        limit = _largest_body(request, self._services.settings)
        counted = request.url.path != DATA_PATH
        try:
            _check_host(request, self._services.settings)
            _check_origin(request)
            _check_size(request, limit)
            await self._admit(request)
            self._access.check(request)
        except ServiceError as error:
            await problems.refusal(request, error)(request.scope, receive, send)
        except problems.OUTAGES as error:
            await problems.outage(request, error)(request.scope, receive, send)
        else:
            await self._app(request.scope, _bounded(receive, limit, counted=counted), send)

    async def _admit(self, request: Request) -> None:
        """Say who asks, for handlers, events and logs. Raises Unauthenticated, TooManyFailedKeys."""
        if request.url.path in PUBLIC or request.url.path.startswith(PUBLIC_FOLDER):
            return
        who = await self._caller(request)
        request.state.caller = who
        origin.bind_actor(who.actor)

    async def _caller(self, request: Request) -> Caller:
        shown = request.headers.get("authorization")
        settings = self._services.settings
        if shown is None and settings.embedded and settings.keyless and _is_local(request):
            return ON_THIS_MACHINE
        scheme, _, secret = (shown or "").partition(" ")
        if scheme.lower() != "bearer" or not secret.strip():
            raise Unauthenticated(NO_KEY)
        return await run_in_threadpool(self._verified, secret.strip(), request.client.host if request.client else "")

    def _verified(self, secret: str, host: str) -> Caller:
        claimed = keys.named_by(secret)
        if not self._failed.is_good(secret):
            self._failed.check(host, claimed)
        try:
            with self._services.database.read() as session:
                found = Caller.of(keys.verify(session, secret, self._services.clock()))
        except Unauthenticated:
            self._failed.count(host, claimed)
            raise
        self._failed.vouch(secret)
        return found


def _correlation(request: Request) -> str:
    """The id that the client gave the request, where it can stand in a log line; else one of our own."""
    given = request.headers.get(CORRELATION, "")
    return given if re.fullmatch(r"[A-Za-z0-9._:@-]{1,100}", given) else uuid4().hex


def _with_headers(send: Send, headers: dict[str, str]) -> Send:
    """Every answer has these, unless it says otherwise."""
    encoded = [(name.lower().encode(), value.encode()) for name, value in headers.items()]

    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            own = list(message.get("headers", []))
            said = {name.lower() for name, _ in own}
            message["headers"] = own + [(name, value) for name, value in encoded if name not in said]
        await send(message)

    return sent


def _largest_body(request: Request, settings: Settings) -> int:
    """Parsed JSON takes twenty times its bytes and more, so only bodies that bring data may be long."""
    if request.url.path == DATA_PATH:
        return settings.max_body_bytes
    own = settings.max_labels_bytes if request.url.path == "/labels" else settings.max_json_bytes
    return min(own, settings.max_body_bytes)


def _check_host(request: Request, settings: Settings) -> None:
    host = request.headers.get("host", "")
    if "*" not in settings.allowed_hosts and _without_port(host) not in settings.allowed_hosts:
        raise CrossOrigin(f"host: {host[:200]!r} is not a name of this service")


def _check_origin(request: Request) -> None:
    origin = request.headers.get("origin")
    if request.method in SAFE_METHODS or origin is None:
        return
    if origin.partition("://")[2] != request.headers.get("host"):
        raise CrossOrigin(f"origin: {origin[:200]!r} may not write to this service")


def _check_size(request: Request, limit: int) -> None:
    length = request.headers.get("content-length", "0")
    if length.isdigit() and int(length) > limit:
        raise BodyTooLarge(f"content-length: {length} bytes, {limit} are allowed")


def _bounded(receive: Receive, limit: int, *, counted: bool) -> Receive:
    """A chunked body says no length: count it. FastAPI lets only its own exception through while it reads a body.

    counted: count what JSON of it would be made into, too, before anybody makes it.
    """
    total, values, containers = 0, 0, 0

    async def read() -> Message:
        nonlocal total, values, containers
        message = await receive()
        body = message.get("body", b"")
        total += len(body)
        if counted:
            values += body.count(b",")
            containers += body.count(b"[") + body.count(b"{")
        for found, most, what in (
            (total, limit, "bytes"),
            (values, MOST_VALUES, "values"),
            (containers, MOST_CONTAINERS, "lists and objects"),
        ):
            if found > most:
                raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"body: {found} {what}, {most} are allowed")
        return message

    return read


def _is_local(request: Request) -> bool:
    """Asked by a program of this machine, in its own name."""
    if any(name in request.headers for name in FORWARDED):
        return False
    try:
        return ip_address(request.client.host if request.client else "").is_loopback
    except ValueError:
        return False


def _without_port(host: str) -> str:
    name, _, port = host.rpartition(":")
    return name if name and port.isdigit() else host
