"""What a browser may do: only pages of this service's own host, and only this host's names."""

from urllib.parse import urlsplit

from fastapi import FastAPI
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.api import problems
from service.errors import BodyTooLarge, CrossOrigin, ServiceError
from service.settings import Settings

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})


def install(app: FastAPI, settings: Settings) -> None:
    """Refuse foreign Host headers (DNS rebinding), cross-origin writes and bodies over the limit."""
    app.add_middleware(Guard, settings=settings)


class Guard:
    """A plain ASGI middleware: the decorator's kind copies every body through a queue."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app, self._settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a refusal, or pass the request on."""
        if scope["type"] == "http":
            headers = Headers(scope=scope)
            try:
                _check_host(headers, self._settings)
                _check_origin(scope["method"], headers)
                _check_size(headers, self._settings.max_body_bytes)
            except ServiceError as error:
                await problems.answer(error.problem(scope["path"]))(scope, receive, send)
                return
        await self._app(scope, receive, send)


def _check_host(headers: Headers, settings: Settings) -> None:
    host = headers.get("host", "")
    if "*" not in settings.allowed_hosts and _without_port(host) not in settings.allowed_hosts:
        raise CrossOrigin(f"host: {host[:200]!r} is not a name of this service")


def _check_origin(method: str, headers: Headers) -> None:
    origin = headers.get("origin")
    if method in SAFE_METHODS or origin is None:
        return
    if urlsplit(origin).netloc != headers.get("host"):
        raise CrossOrigin(f"origin: {origin[:200]!r} may not write to this service")


def _check_size(headers: Headers, limit: int) -> None:
    length = headers.get("content-length", "0")
    if length.isdigit() and int(length) > limit:
        raise BodyTooLarge(f"content-length: {length} bytes, {limit} are allowed")


def _without_port(host: str) -> str:
    name, _, port = host.rpartition(":")
    return name if name and port.isdigit() else host
