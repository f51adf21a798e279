"""Errors of the service: one class an error, each a sentence with a status. The API turns them into problem details.

Here are those that several rules raise; the others stand beside their rule.
"""

import re
from collections.abc import Mapping
from uuid import UUID

from api_schemas.errors import InvalidParam, Problem

LONGEST = 200  # characters of a value that are shown
RETRY_SOON = {"Retry-After": "1"}


class ServiceError(Exception):
    """Base of all expected errors. The class name becomes the problem's type, its docstring the title."""

    status_code = 400
    headers: Mapping[str, str] = {}  # of the answer

    def __init__(self, detail: str, invalid_params: list[InvalidParam] | None = None) -> None:
        super().__init__(detail)
        self.detail = detail
        self.invalid_params = invalid_params or []

    def problem(self, instance: str | None = None) -> Problem:
        """The body to answer with."""
        name = type(self).__name__
        return Problem(
            type="urn:asim:error:" + re.sub(r"(?<!^)(?=[A-Z])", "-", name).lower(),
            title=(self.__doc__ or name).split("\n")[0].rstrip("."),
            status=self.status_code,
            detail=self.detail,
            instance=instance,
            invalid_params=self.invalid_params,
        )


class UnknownResource(ServiceError):
    """There is no such thing."""

    status_code = 404

    def __init__(self, noun: str, name: object) -> None:
        super().__init__(f"there is no {noun} {str(name)[:LONGEST]!r}")


class InvalidField(ServiceError):
    """A field has a value that cannot be taken."""

    status_code = 422

    def __init__(self, name: str, value: object, reason: str) -> None:
        shown = str(value)[:LONGEST]
        super().__init__(f"{name}: {reason}, got {shown}", [InvalidParam(name=name, reason=reason, value=shown)])


class UnknownStrategy(InvalidField):
    """No strategy has this name."""


class PrivilegedStrategy(ServiceError):
    """The strategy looks at the labels that it is to choose."""

    status_code = 403

    def __init__(self, name: str, strategy: str) -> None:
        reason = "needs the hidden actions of the pool, which only a benchmark has; a project cannot use it"
        params = [InvalidParam(name=name, reason=reason, value=strategy)]
        super().__init__(f"{name}: {strategy!r} {reason}", params)


class UnknownBehavior(InvalidField):
    """The simulator has no behavior of this name."""


class NameTaken(ServiceError):
    """Another project has this name."""

    status_code = 409

    def __init__(self, name: str) -> None:
        super().__init__(f"name: a project {name!r} exists already")


class NothingToLearn(ServiceError):
    """A round needs labels to train on."""

    status_code = 409

    def __init__(self, project: UUID) -> None:
        super().__init__(f"project {project} has no pool labels to train on yet")


class NoModelFamily(ServiceError):
    """No model family takes this project's spaces."""

    status_code = 409

    def __init__(self, project: UUID) -> None:
        super().__init__(f"project {project}: no model family takes its spaces, so no round can train on its labels")


class NoSimulator(ServiceError):
    """The project names no simulator to run."""

    status_code = 409

    def __init__(self, project: UUID) -> None:
        super().__init__(f"project {project} names no simulator; upload trajectories instead of collecting them")
