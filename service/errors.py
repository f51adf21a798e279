"""Errors of the service: one class an error, each a sentence with a status. The API turns them into problem details."""

import re
from collections.abc import Mapping, Sequence
from datetime import datetime
from uuid import UUID

from api_schemas.errors import InvalidParam, Problem

LONGEST = 200  # characters of a value that are shown
SHOWN = 5  # steps of two labels that differ
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


class InvalidLabel(InvalidField):
    """A label does not fit its segment or the project's action space."""


class InvalidTrajectory(InvalidField):
    """A trajectory does not fit the project's observation space, or its arrays disagree."""


class ForeignFile(ServiceError):
    """A file is truncated or of another format."""

    status_code = 400

    def __init__(self, source: str, reason: str) -> None:
        super().__init__(f"{source}: {reason}")


class CorruptBlob(ServiceError):
    """A stored blob does not match its hash."""

    status_code = 500

    def __init__(self, key: str, expected: str, found: str) -> None:
        super().__init__(f"blob {key} should have the hash {expected}, its bytes have {found}")


class MissingBlob(ServiceError):
    """A blob that a row refers to is not in the store."""

    status_code = 500

    def __init__(self, key: str) -> None:
        super().__init__(f"blob {key} is not in the store")


class BlobsUnavailable(ServiceError):
    """The blob store is unavailable."""

    status_code = 503
    headers = RETRY_SOON

    def __init__(self, key: str, reason: str) -> None:
        super().__init__(f"blob {key}: its store did not do what was asked; nothing was stored, try again: {reason}")


class NameTaken(ServiceError):
    """Another project has this name."""

    status_code = 409

    def __init__(self, name: str) -> None:
        super().__init__(f"name: a project {name!r} exists already")


class PoolExhausted(ServiceError):
    """The pool has no segment left to give."""

    status_code = 409

    def __init__(self, asked: int, unlabeled: int, purpose: str) -> None:
        super().__init__(
            f"count: asked for {asked} segments, {unlabeled} are unlabeled and free in the {purpose} split"
        )


class NothingToExplore(ServiceError):
    """The pool holds no state to explore from."""

    status_code = 409

    def __init__(self, project: UUID, simulator: str | None) -> None:
        missing = "trajectory" if simulator is None else f"trajectory whose states in {simulator} are kept"
        super().__init__(f"mode: project {project} has no {missing} in its pool that an exploration could start from")


class AllExplored(ServiceError):
    """What a strategy can propose under a round's models has all been given out."""

    status_code = 409

    def __init__(self, project: UUID, strategy: str, round_number: int) -> None:
        super().__init__(
            f"mode: all that {strategy} finds to explore in the pool of project {project} under the models of round "
            f"{round_number} has been given out; more comes with the next round or with more trajectories"
        )


class BudgetExhausted(ServiceError):
    """The project's label budget does not cover this."""

    status_code = 409

    def __init__(self, asked: int, remaining: int, total: int) -> None:
        super().__init__(f"count: asked for {asked} segments, {remaining} of the budget of {total} labels remain")


class KeyBusy(ServiceError):
    """Too many requests use this Idempotency-Key at this moment."""

    status_code = 503
    headers = RETRY_SOON

    def __init__(self, key: str) -> None:
        super().__init__(
            f"Idempotency-Key {key[:LONGEST]!r} is in use by other requests; nothing was stored, try again"
        )


class IdempotencyKeyReused(ServiceError):
    """An Idempotency-Key stands for one request."""

    status_code = 422

    def __init__(self, key: str, route: str) -> None:
        reason = f"was used for another body of {route}"
        super().__init__(
            f"Idempotency-Key: {key!r} {reason}", [InvalidParam(name="Idempotency-Key", reason=reason, value=key)]
        )


class InvalidLeaseToken(ServiceError):
    """The token is not the one that this acquisition was given."""

    status_code = 403

    def __init__(self, acquisition: UUID, token: int | None) -> None:
        given = "no token was sent" if token is None else f"{token} is not it"
        super().__init__(f"token: acquisition {acquisition} needs the token of its lease; {given}")


class LeaseLost(ServiceError):
    """The lease has ended and cannot be used any more."""

    status_code = 410

    def __init__(self, acquisition: UUID, reason: str) -> None:
        super().__init__(f"acquisition {acquisition}: {reason}")


class SegmentLeased(ServiceError):
    """Somebody else holds the segment."""

    status_code = 423

    def __init__(self, trajectory: str, start: int, until: datetime) -> None:
        super().__init__(f"segment {trajectory}:{start} is leased to another labeler until {until.isoformat()}")


class LabelConflict(ServiceError):
    """The segment has another label already."""

    status_code = 409

    def __init__(self, trajectory: str, start: int, stored: Sequence[object], sent: Sequence[object]) -> None:
        apart = [step for step in range(min(len(stored), len(sent))) if _content(stored[step]) != _content(sent[step])]
        short = max(len(str(stored)), len(str(sent))) <= LONGEST
        first = 0 if short or not apart else apart[0]
        part = slice(None) if short else slice(first, first + SHOWN)
        params = [
            InvalidParam(name=f"step {step}", reason=f"is labeled {_shown(stored[step])}", value=_shown(sent[step]))
            for step in apart[:SHOWN]
        ]
        place = f"segment {trajectory}:{start}" if short else f"segment {trajectory}:{start}, from its step {first} on,"
        differ = f"is different in {len(apart)} of {len(sent)} steps and was not stored"
        super().__init__(f"{place} is labeled {_shown(stored[part])}; {_shown(sent[part])} {differ}", params)


class SplitConflict(ServiceError):
    """The trajectory is in the other split of this project."""

    status_code = 409

    def __init__(self, trajectory: str, split: str, asked: str) -> None:
        super().__init__(f"split: trajectory {trajectory} is in the split {split!r} of this project, not in {asked!r}")


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


class NoProvenance(ServiceError):
    """No simulator states are kept for this trajectory, or not in reach of this process."""

    status_code = 404

    def __init__(self, trajectory: str) -> None:
        super().__init__(f"trajectory {trajectory} has no provenance here")


class PoliciesOutOfReach(ServiceError):
    """The store of policies' weights is not in reach of this process."""

    status_code = 404

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}: weights of policies are in the provenance store, which is not in reach here")


class NotAllowed(ServiceError):
    """The key does not allow this."""

    status_code = 403


class Unauthenticated(ServiceError):
    """A valid API key is needed."""

    status_code = 401
    headers = {"WWW-Authenticate": "Bearer"}


class TooManyFailedKeys(ServiceError):
    """Too many API keys that open nothing came from here."""

    status_code = 429

    def __init__(self, failures: int, seconds: int) -> None:
        super().__init__(
            f"authorization: {failures} keys of this machine failed within a minute; try again in {seconds} s"
        )
        self.headers = {"Retry-After": str(seconds)}


class CrossOrigin(ServiceError):
    """The request comes from another site's page."""

    status_code = 403


class BodyTooLarge(ServiceError):
    """The request is larger than this service takes."""

    status_code = 413


class JobFinished(ServiceError):
    """A job that has ended cannot be cancelled."""

    status_code = 409

    def __init__(self, job: UUID, state: str, successor: UUID | None = None) -> None:
        left = f"its round goes on in job {successor}" if successor else "there is nothing left to cancel"
        super().__init__(f"job {job} is {state}; {left}")


class JobLost(ServiceError):
    """Another worker holds this job by now; what this one did is not stored."""

    status_code = 409

    def __init__(self, job: UUID, fence: int) -> None:
        super().__init__(f"job {job}: fence {fence} is not the current one")


def _shown(value: object) -> str:
    """At most LONGEST characters of it."""
    text = str(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _content(step: object) -> str:
    """A step's action, or the set of actions that explain it, in whatever order they are named."""
    choices = step if isinstance(step, list) else [step]
    discrete = all(isinstance(choice, int) for choice in choices)
    return str(sorted(set(choices)) if discrete else choices)
