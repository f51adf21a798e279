"""/openapi.json: FastAPI's description of the API, with the errors that an endpoint answers as problem details.

An endpoint names the errors of its own rule (`responses=refuses(LeaseLost)`); those of the guard, and of what a request
carries, follow from the endpoint's form.
"""

import re
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.routing import compile_path

from api_schemas.errors import PROBLEM_JSON, Problem
from service.errors import ServiceError

Json = dict[str, Any]
PROBLEM = {PROBLEM_JSON: {"schema": {"$ref": "#/components/schemas/Problem"}}}
EVERYWHERE = {403: "The host is not a name of this service", 413: "The request is larger than this service takes"}
WITH_VALUES = {422: "A value cannot be taken"}
WITH_A_KEY = {
    401: "A valid API key is needed",
    403: "The key does not allow this, or the request comes from another site's page",
    429: "Too many API keys that open nothing came from here",
    503: "The database is unavailable",
}
WITH_A_NAME = {404: "There is no such thing"}
WITH_A_BODY = {400: "The body cannot be read"}
REPLACED = ("HTTPValidationError", "ValidationError")  # FastAPI's own, which this service answers as a problem
REPLACED_TEXT = "Validation Error"


def refuses(*errors: type[ServiceError]) -> dict[int | str, Json]:
    """The errors of an endpoint's rule, as a route's `responses`."""
    told: dict[int | str, Json] = {}
    for error in errors:
        title = _title(error)
        before = told.get(error.status_code, {}).get("description")
        told[error.status_code] = {"description": f"{before}; {title}" if before else title}
    return told


def install(app: FastAPI) -> None:
    """Answer /openapi.json with the whole description, made once."""
    app.openapi = _described(app)  # type: ignore[method-assign]  # FastAPI's documented way to extend it


def methods(app: FastAPI, path: str) -> list[str]:
    """That are described for the path."""
    return sorted(
        method.upper()
        for known, operations in app.openapi()["paths"].items()
        if compile_path(known)[0].match(path)
        for method in operations
    )


def _described(app: FastAPI) -> Callable[[], Json]:
    def openapi() -> Json:
        if app.openapi_schema is None:
            told = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
            app.openapi_schema = _with_problems(told)
        return app.openapi_schema

    return openapi


def _with_problems(told: Json) -> Json:
    schemas: Json = told["components"]["schemas"]
    for name in REPLACED:
        schemas.pop(name, None)
    made = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas |= made.pop("$defs") | {"Problem": made}
    for path, operation in _operations(told):
        operation["responses"] = _answers(operation["responses"], _general(path, operation, schemas))
    return told


def _answers(declared: Json, general: dict[int, str]) -> Json:
    """By status: what the endpoint declares, and the general errors."""
    answers = {status: answer for status, answer in declared.items() if answer["description"] != REPLACED_TEXT}
    for status, text in general.items():
        own = answers.get(str(status), {}).get("description")
        answers[str(status)] = {"description": f"{text}; {own}" if own else text}
    for code, answer in answers.items():
        if int(code) >= HTTPStatus.BAD_REQUEST:
            answer.setdefault("content", PROBLEM)
    return dict(sorted(answers.items()))


def _general(path: str, operation: Json, schemas: Json) -> dict[int, str]:
    """Errors that do not come of the endpoint's own rule."""
    names = [parameter["name"] for parameter in operation.get("parameters", [])] + _fields(operation, schemas)
    found = dict(EVERYWHERE)
    if names:
        found |= WITH_VALUES
    if "{" in path or "project" in names:
        found |= WITH_A_NAME
    if "security" in operation:
        found |= WITH_A_KEY
    if "requestBody" in operation:
        found |= WITH_A_BODY
    return found


def _fields(operation: Json, schemas: Json) -> list[str]:
    """Of the body."""
    found: list[str] = []
    for content in operation.get("requestBody", {}).get("content", {}).values():
        told = content["schema"]
        found += schemas.get(told.get("$ref", "").rpartition("/")[2], told).get("properties", {})
    return found


def _operations(told: Json) -> Iterator[tuple[str, Json]]:
    for path, methods in told["paths"].items():
        for operation in methods.values():
            yield path, operation


def _title(error: type[ServiceError]) -> str:
    return (error.__doc__ or re.sub(r"(?<!^)(?=[A-Z])", " ", error.__name__)).split("\n")[0].rstrip(".")
