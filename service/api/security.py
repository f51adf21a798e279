"""Before any handler: what a browser may do, how large a body may be, and which request this is.

Browsers may use pages of this service's own host only, under this host's names only.
"""

import re
from http import HTTPStatus
from uuid import uuid4

from fastapi import FastAPI, HTTPException, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import origin
from service.api import problems
from service.errors import BodyTooLarge, CrossOrigin, ServiceError
from service.settings import Settings

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
CORRELATION = "X-Correlation-ID"


def install(app: FastAPI, settings: Settings) -> None:
    """Refuse foreign Host headers (DNS rebinding), cross-origin writes and bodies over the limit."""
    app.add_middleware(Guard, settings=settings)


class Guard:
    """The middleware; plain ASGI, because Starlette's base class copies every request through a task of its own."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app, self._settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        correlation = request.state.correlation = _correlation(request)
        with origin.bound(actor="", correlation=correlation):
            await self._guarded(request, receive, _naming(send, correlation))

    async def _guarded(self, request: Request, receive: Receive, send: Send) -> None:
        limit = _largest_body(request, self._settings)
        try:
            _check_host(request, self._settings)
            _check_origin(request)
            _check_size(request, limit)
        except ServiceError as error:
            await problems.answer(error.problem(request.url.path))(request.scope, receive, send)
        else:
            await self._app(request.scope, _bounded(receive, limit), send)


def _correlation(request: Request) -> str:
    """The id that the client gave the request, where it can stand in a log line; else one of our own."""
    given = request.headers.get(CORRELATION, "")
    return given if re.fullmatch(r"[A-Za-z0-9._:@-]{1,100}", given) else uuid4().hex


def _naming(send: Send, correlation: str) -> Send:
    """Every answer says by which id logs and events know its request."""

    async def named(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", []), (CORRELATION.lower().encode(), correlation.encode())]
        await send(message)

    return named


def _largest_body(request: Request, settings: Settings) -> int:
    if request.method == "POST" and request.url.path == "/labels":
        return min(settings.max_labels_bytes, settings.max_body_bytes)
    return settings.max_body_bytes


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


def _bounded(receive: Receive, limit: int) -> Receive:
    """A chunked body says no length: count it. FastAPI lets only its own exception through while it reads a body."""
    total = 0

    async def counted() -> Message:
        nonlocal total
        message = await receive()
        total += len(message.get("body", b""))
        if total > limit:
            raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"body: {total} bytes, {limit} are allowed")
        return message

    return counted


def _without_port(host: str) -> str:
    name, _, port = host.rpartition(":")
    return name if name and port.isdigit() else host
