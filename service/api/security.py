"""What a browser may do: only pages of this service's own host, and only this host's names."""

from http import HTTPStatus

from fastapi import FastAPI, HTTPException, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api import problems
from service.errors import BodyTooLarge, CrossOrigin, ServiceError
from service.settings import Settings

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})


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
        try:
            _check_host(request, self._settings)
            _check_origin(request)
            _check_size(request, self._settings.max_body_bytes)
        except ServiceError as error:
            await problems.answer(error.problem(request.url.path))(scope, receive, send)
        else:
            await self._app(scope, _bounded(receive, self._settings.max_body_bytes), send)


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
