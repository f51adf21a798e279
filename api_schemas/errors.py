"""The body of every error: problem details, RFC 9457."""

from api_schemas.base import Schema

PROBLEM_JSON = "application/problem+json"


class InvalidParam(Schema):
    """One field that was refused: where it stands, why, and the value that was sent."""

    name: str
    reason: str
    value: str | None = None


class Problem(Schema):
    """`type` is a stable name of the error class; `detail` is a sentence with the offending values."""

    type: str
    title: str
    status: int
    detail: str
    instance: str | None = None
    invalid_params: list[InvalidParam] = []
