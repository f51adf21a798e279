"""Loaded by schemathesis, in its process: real names among the made-up ones, and a check of our own.

ASIM_THINGS names a JSON file with the id of one thing of each kind.
"""

import base64
import json
import os
import zlib
from pathlib import Path
from typing import Any

import schemathesis
from schemathesis.generation import GenerationMode

THINGS: dict[str, Any] = json.loads(Path(os.environ["ASIM_THINGS"]).read_text())
# How pydantic begins what it says of a value that its own schema refuses; our sentences are about fields that must fit
# each other (spaces and simulator; mode and purpose; rank and split).
PYDANTIC = ("Input should", "Field required", "Extra inputs", "String should", "List should", "Tuple should")
CURSORS: tuple[object, ...] = (
    *(["2026-01-01T00:00:00+00:00", "x"], ["0001-01-01T00:00:00+14:00", "x"], [2**70], [None], [[1]], {}, 1, "x", []),
    *([True, 1], [1e300, 1], ["9999-12-31T23:59:59-14:00", "12345678-1234-5678-1234-567812345678"]),
)


@schemathesis.hook
def before_call(context: Any, case: Any, kwargs: Any) -> None:
    """Three in four ids that the case made up become ids of things that are there."""
    for part in (case.path_parameters, case.query, case.body):
        _name_real_things(part)
    if isinstance(case.query, dict) and isinstance(case.query.get("cursor"), str):
        case.query["cursor"] = _cursor(case.query["cursor"])


@schemathesis.check
def a_described_value_is_not_malformed(ctx: Any, response: Any, case: Any) -> None:
    """What the description allows passes the schemas; only rules may refuse it."""
    generation = case.meta.generation if case.meta else None
    if generation is None or generation.mode is not GenerationMode.POSITIVE or response.status_code != 422:
        return
    for param in response.json()["invalid_params"]:
        assert not param["reason"].startswith(PYDANTIC), response.json()["detail"]


def _name_real_things(part: Any) -> None:
    if isinstance(part, list):
        for each in part:
            _name_real_things(each)
    if isinstance(part, dict):
        for name, value in part.items():
            if name in THINGS and type(value) is type(THINGS[name]) and _often(value):
                part[name] = THINGS[name]
            else:
                _name_real_things(value)


def _cursor(made_up: str) -> str:
    """One that can be read, and says what no listing gave out; or brackets without end."""
    number = zlib.crc32(made_up.encode("utf-8", "replace")) % (len(CURSORS) + 1)
    told = json.dumps(CURSORS[number]) if number < len(CURSORS) else "[" * 20_000
    return base64.urlsafe_b64encode(told.encode()).decode()


def _often(value: object) -> bool:
    """Decided by the value, so that a case is the same when it is run again."""
    return zlib.crc32(str(value).encode("utf-8", "replace")) % 4 != 0
