"""What a browser may do: only pages of this service's own host, and only this host's names."""

from collections.abc import Awaitable, Callable
from urllib.parse import urlsplit

from fastapi import FastAPI, Request, Response

from service.api import problems
from service.errors import BodyTooLarge, CrossOrigin, ServiceError
from service.settings import Settings

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
Next = Callable[[Request], Awaitable[Response]]


def install(app: FastAPI, settings: Settings) -> None:
    """Refuse foreign Host headers (DNS rebinding), cross-origin writes and bodies over the limit."""

    @app.middleware("http")
    async def guard(request: Request, call_next: Next) -> Response:
        try:
            _check_host(request, settings)
            _check_origin(request)
            _check_size(request, settings.max_body_bytes)
        except ServiceError as error:
            return problems.answer(error.problem(request.url.path))
        return await call_next(request)


def _check_host(request: Request, settings: Settings) -> None:
    host = request.headers.get("host", "")
    if "*" not in settings.allowed_hosts and _without_port(host) not in settings.allowed_hosts:
        raise CrossOrigin(f"host: {host[:200]!r} is not a name of this service")


def _check_origin(request: Request) -> None:
    origin = request.headers.get("origin")
    if request.method in SAFE_METHODS or origin is None:
        return
    if urlsplit(origin).netloc != request.headers.get("host"):
        raise CrossOrigin(f"origin: {origin[:200]!r} may not write to this service")


def _check_size(request: Request, limit: int) -> None:
    length = request.headers.get("content-length", "0")
    if length.isdigit() and int(length) > limit:
        raise BodyTooLarge(f"content-length: {length} bytes, {limit} are allowed")


def _without_port(host: str) -> str:
    name, _, port = host.rpartition(":")
    return name if name and port.isdigit() else host
