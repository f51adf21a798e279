"""The labeler's side of a lease: extended while labeling takes long, given back where something stays unanswered."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime

from api_schemas.acquisitions import Acquisition
from asim.client import Client
from asim.errors import Conflict, LeaseLost

LONGEST_LEASE = 30 * 86400.0  # seconds that the service gives at once
NEVER = datetime.max.replace(tzinfo=UTC)
Clock = Callable[[], datetime]


class Lease:
    """Keeps the lease of a batch that takes long to label: once half of what is left has passed, it is extended.

    clock: the time of day, which may differ from the service's by less than the lease.
    """

    def __init__(self, client: Client, acquisition: Acquisition, clock: Clock) -> None:
        self._client, self._acquisition, self._clock = client, acquisition, clock
        taken = acquisition.lease_expires_at - acquisition.created_at
        self._seconds = min(taken.total_seconds(), LONGEST_LEASE)  # as its taker wanted it, not the project's default
        self._half = self._half_way(acquisition)

    def keep(self) -> None:
        """Extend the lease where it is time to. Raises LeaseLost where nothing is left to answer under it."""
        token = self._acquisition.token
        if token is None or self._clock() < self._half:
            return
        try:
            self._half = self._half_way(self._client.extend(self._acquisition.id, token, self._seconds))
        except LeaseLost as error:
            if self._client.acquisition(self._acquisition.id).status != "labeled":
                raise lost([error], len(self._acquisition.items)) or error from error
            self._half = NEVER  # all that follows is a duplicate, no loss: there is nothing to ask for again
        except Conflict:  # others have spent the budget: what of the answers it still has room for, delivery finds out
            self._half = NEVER

    def holds(self) -> bool:
        """Whether anything is left to answer under the lease, which is extended then."""
        if self._acquisition.token is None:
            return True  # nothing can be asked without it: each answer tells for itself
        try:
            self._client.extend(self._acquisition.id, self._acquisition.token, self._seconds)
        except LeaseLost:
            return False
        except Conflict:  # what is held has no room in the budget any more; labels that are there already need none
            return True
        return True

    def give_back(self) -> None:
        """Release what is not answered."""
        if self._acquisition.token is not None:
            with suppress(LeaseLost):  # there is nothing left that could be given back
                self._client.release(self._acquisition.id, self._acquisition.token)

    def _half_way(self, acquisition: Acquisition) -> datetime:
        now = self._clock()
        return now + (acquisition.lease_expires_at - now) / 2


def lost(refused: Sequence[Exception], count: int) -> LeaseLost | None:
    """The lease's loss in a sentence, where that is why answers were refused."""
    losses = [error.problem for error in refused if isinstance(error, LeaseLost)]
    if not losses:
        return None
    detail = f"the lease was lost while its {count} items were answered: {losses[0].detail}"
    return LeaseLost(losses[0].model_copy(update={"detail": detail}))
