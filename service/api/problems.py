"""Every error as problem details, RFC 9457; FastAPI's own included."""

from collections.abc import Mapping
from http import HTTPStatus
from reprlib import Repr

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import DataError, InterfaceError, InternalError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from starlette.exceptions import HTTPException

from api_schemas.errors import PROBLEM_JSON, InvalidParam, Problem
from service.api.description import methods
from service.api.headers import CORRELATION, HEADERS
from service.errors import LONGEST, RETRY_SOON, ServiceError
from service.log import get_logger

log = get_logger("api")
MOST_SHOWN = 20  # wrong fields of one request
BRIEFLY = Repr()
BRIEFLY.maxlevel, BRIEFLY.maxdict, BRIEFLY.maxlist, BRIEFLY.maxtuple = 4, 20, 20, 20
BRIEFLY.maxstring = BRIEFLY.maxother = LONGEST
# A database that is down, full or slow; "internal" is what PostgreSQL calls that it ended an idle transaction.
OUTAGES = (OperationalError, InterfaceError, InternalError, PoolTimeout)


class BodyTooLarge(ServiceError):
    """The request is larger than this service takes."""

    status_code = 413


def install(app: FastAPI) -> None:
    """Answer all errors of `app` as problem details."""
    app.add_exception_handler(ServiceError, _service_error)
    app.add_exception_handler(RequestValidationError, _malformed)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(DataError, _unstorable)
    for unavailable in OUTAGES:
        app.add_exception_handler(unavailable, outage)
    app.add_exception_handler(Exception, _unexpected)


def refusal(request: Request, error: ServiceError) -> JSONResponse:
    """An expected error as a response."""
    return answer(error.problem(request.url.path), error.headers)


def answer(problem: Problem, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """The problem as a response."""
    body = problem.model_dump(mode="json", exclude_none=True)
    return JSONResponse(body, problem.status, headers=headers, media_type=PROBLEM_JSON)


def _service_error(request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, ServiceError):
        raise error
    return refusal(request, error)


def _malformed(request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, RequestValidationError):
        raise error
    params = [
        InvalidParam(
            name=_printable(".".join(str(part) for part in problem["loc"] if part != "body")) or "body",
            reason=_printable(str(problem["msg"]).removeprefix("Value error, ")),
            value=_printable(_shown(problem.get("input"))),
        )
        for problem in error.errors()[:MOST_SHOWN]
    ]
    detail = "; ".join(f"{param.name}: {param.reason}, got {param.value}" for param in params)
    return answer(_problem("malformed-request", 422, "The request is malformed", detail, request, params))


def _http_error(request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, HTTPException):
        raise error
    if error.status_code == HTTPStatus.REQUEST_ENTITY_TOO_LARGE:  # a body that did not say its length beforehand
        return refusal(request, BodyTooLarge(str(error.detail)))
    headers = dict(error.headers or {})
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:  # Starlette names the methods of one of the path's routes
        headers["Allow"] = ", ".join(methods(request.app, request.url.path)) or headers.get("Allow", "")
    if isinstance(error.__cause__, RecursionError):
        return answer(_problem("bad-request", 400, "Bad Request", "body: is nested too deeply", request))
    title = HTTPStatus(error.status_code).phrase
    problem = _problem(title.lower().replace(" ", "-"), error.status_code, title, str(error.detail), request)
    return answer(problem, headers)


def _unstorable(request: Request, error: Exception) -> JSONResponse:
    reason = str(error.orig) if isinstance(error, DataError) else str(error)
    detail = f"a value cannot be stored: {_printable(reason)}"
    return answer(_problem("unstorable-value", 422, "A value cannot be stored", detail, request))


def outage(request: Request, error: Exception) -> JSONResponse:
    """Of the database, as a response."""
    log.error("database_error", path=request.url.path, error=str(error))
    detail = "the database did not answer, or not in time; what was sent is stored as a whole or not at all, try again"
    return answer(_problem("database-unavailable", 503, "The database is unavailable", detail, request), RETRY_SOON)


def _unexpected(request: Request, error: Exception) -> JSONResponse:
    # Starlette calls this outside of all middleware, so neither the request's id nor the headers are in the answer yet.
    correlation = getattr(request.state, "correlation", "")
    log.error("unexpected_error", path=request.url.path, correlation=correlation, exc_info=error)
    detail = "the service failed; nothing was stored, the log says why"
    problem = _problem("internal-error", 500, "The service failed", detail, request)
    return answer(problem, HEADERS | {CORRELATION: correlation})


def _shown(value: object) -> str:
    """The beginning of it; the whole of a large body as text would be a second body."""
    return value[:LONGEST] if isinstance(value, str) else BRIEFLY.repr(value)


def _printable(text: str) -> str:
    """At most LONGEST characters that UTF-8 can carry: JSON may hold halves of a surrogate pair."""
    return text[:LONGEST].encode("utf-8", "backslashreplace").decode()


def _problem(
    name: str, status: int, title: str, detail: str, request: Request, params: list[InvalidParam] | None = None
) -> Problem:
    return Problem(
        type=f"urn:asim:error:{name}",
        title=title,
        status=status,
        detail=detail,
        instance=request.url.path,
        invalid_params=params or [],
    )
