"""What goes wrong between a user and the service, as exceptions that read as sentences."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from api_schemas.errors import Problem
    from api_schemas.jobs import Job
    from api_schemas.rounds import Round


class AsimError(Exception):
    """Base of everything that this package raises on purpose; its text is one sentence for a person."""


class ServiceError(AsimError):
    """The service refused a request. `problem` is its answer: type, status, detail and the refused fields."""

    def __init__(self, problem: "Problem") -> None:
        super().__init__(_sentence(problem))
        self.problem = problem


class Invalid(ServiceError):
    """400, 413, 415, 422: the request itself is wrong."""


class Forbidden(ServiceError):
    """401, 403: no key, or one without the needed scope."""


class NotFound(ServiceError):
    """404: there is no such thing."""


class Conflict(ServiceError):
    """409, 410, 412, 423: as things stand it cannot be: another's lease, a different label, a spent budget."""


class LeaseLost(Conflict):
    """410 of a lease: it was given back, or others hold by now what it covered."""


class Unavailable(ServiceError):
    """429, 502, 503, 504: not now; try again later."""


class Unreachable(AsimError):
    """No answer at all: nothing listens at the URL, or the connection broke."""


class NotReady(AsimError):
    """The wait was over before the service was done."""


class JobFailed(AsimError):
    """A job ended in failure; `job.error` says why."""

    def __init__(self, job: "Job", outcome: str | None = None) -> None:
        super().__init__(f"job {job.id} ({job.kind}) {outcome or _failed(job.error)}")
        self.job = job


class JobCancelled(JobFailed):
    """Somebody cancelled a job before it was done."""

    def __init__(self, job: "Job") -> None:
        super().__init__(job, "was cancelled before it was done")


class RoundFailed(AsimError):
    """A round ended in failure; `round.error` says why."""

    def __init__(self, failed: "Round", outcome: str | None = None) -> None:
        super().__init__(f"round {failed.number} ({failed.id}) {outcome or _failed(failed.error)}")
        self.round = failed


class RoundCancelled(RoundFailed):
    """Somebody cancelled the job of a round before the round was current."""

    def __init__(self, cancelled: "Round") -> None:
        super().__init__(cancelled, "was cancelled before it was current")


_BY_STATUS: dict[int, type[ServiceError]] = {
    **dict.fromkeys((400, 413, 415, 422), Invalid),
    **dict.fromkeys((401, 403), Forbidden),
    404: NotFound,
    **dict.fromkeys((409, 410, 412, 423), Conflict),
    **dict.fromkeys((429, 502, 503, 504), Unavailable),
}

_BY_TYPE: dict[str, type[ServiceError]] = {"urn:asim:error:lease-lost": LeaseLost}


def service_error(problem: "Problem") -> ServiceError:
    """The exception of `problem`'s type, else of its status; ServiceError itself where neither has a class."""
    return (_BY_TYPE.get(problem.type) or _BY_STATUS.get(problem.status, ServiceError))(problem)


def _failed(reason: str | None) -> str:
    return f"failed: {reason or 'no reason was recorded'}"


def _sentence(problem: "Problem") -> str:
    refused = [
        f"{param.name}: {param.reason}" + ("" if param.value is None else f" (got {param.value})")
        for param in problem.invalid_params
        if param.reason not in problem.detail  # else it would be said twice
    ]
    return f"{problem.detail} [{'; '.join(refused)}]" if refused else problem.detail
