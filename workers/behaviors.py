"""Behaviors by the names that collections and provenance have for them: a simulator's own, and policies."""

from collections.abc import Callable

from api_schemas.policies import PREFIX
from workers.simulators.base import Behavior, Simulator
from workers.simulators.catalog import make_behavior

Weights = Callable[[str], bytes]
"""The weights of a policy, by their hash."""


def behavior_named(name: str, simulator: Simulator, weights: Weights) -> Behavior:
    """The named behavior. Raises OptionError for a name that the simulator has no behavior of."""
    if not name.startswith(PREFIX):
        return make_behavior(name, simulator)
    from workers.policies import rolled_out  # torch, for policies alone

    return rolled_out(weights(name.removeprefix(PREFIX)))
