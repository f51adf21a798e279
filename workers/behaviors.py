"""Behaviors by the names that collections and provenance have for them: a simulator's own, and policies."""

from collections.abc import Callable
from functools import cache, partial
from uuid import UUID

from api_schemas.policies import PREFIX
from asim.client import Client
from asim.errors import NotFound
from workers.replay import Behaviors
from workers.simulators.base import Behavior, OptionError, Simulator
from workers.simulators.catalog import make_behavior

Weights = Callable[[str], bytes]
"""The weights of a policy, by their hash."""


def behavior_named(name: str, simulator: Simulator, weights: Weights) -> Behavior:
    """The named behavior. Raises OptionError for a name that the simulator has no behavior of."""
    if not name.startswith(PREFIX):
        return make_behavior(name, simulator)
    from workers.policies import rolled_out  # torch, for policies alone

    return rolled_out(weights(name.removeprefix(PREFIX)))


def behaviors_of(client: Client, project: UUID) -> Behaviors:
    """The simulator's own and the project's policies, each of which is fetched once."""

    @cache
    def weights(sha256: str) -> bytes:
        try:
            return client.policy_weights(project, sha256)
        except NotFound as error:
            raise OptionError(str(error)) from error

    return partial(behavior_named, weights=weights)
