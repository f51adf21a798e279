"""Loaded by schemathesis, in its process: real names among the made-up ones, and a check of our own.

ASIM_THINGS names a JSON file with the id of one thing of each kind.
"""

import json
import os
import zlib
from pathlib import Path
from typing import Any

import schemathesis
from schemathesis.generation import GenerationMode

THINGS: dict[str, Any] = json.loads(Path(os.environ["ASIM_THINGS"]).read_text())
MALFORMED = "urn:asim:error:malformed-request"
# Their bodies have fields that must fit each other (spaces and simulator; mode and purpose; rank and split).
FIELDS_DEPEND = {"POST /projects", "POST /acquire", "POST /labels", "PATCH /projects/{project_id}"}


@schemathesis.hook
def before_call(context: Any, case: Any, kwargs: Any) -> None:
    """Three in four ids that the case made up become ids of things that are there."""
    for part in (case.path_parameters, case.query, case.body):
        _name_real_things(part)


@schemathesis.check
def a_described_value_is_not_malformed(ctx: Any, response: Any, case: Any) -> None:
    """What the description allows passes the schemas; only rules may refuse it."""
    generation = case.meta.generation if case.meta else None
    if generation is None or generation.mode is not GenerationMode.POSITIVE or response.status_code != 422:
        return
    if case.operation.label not in FIELDS_DEPEND:
        assert response.json()["type"] != MALFORMED, response.json()["detail"]


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


def _often(value: object) -> bool:
    """Decided by the value, so that a case is the same when it is run again."""
    return zlib.crc32(str(value).encode("utf-8", "replace")) % 4 != 0
