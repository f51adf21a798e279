"""Actions of a label, held against the project's action space."""

import math
from collections.abc import Sequence

from api_schemas.environments import BoxActions, DiscreteActions, Spaces
from api_schemas.labels import Action
from service.errors import InvalidLabel


def check_actions(spaces: Spaces, actions: Sequence[Action], sets: Sequence[list[int]] | None, name: str) -> None:
    """Actions in the action space, one set an action that holds it. Raises InvalidLabel."""
    for step, action in enumerate(actions):
        _check_action(spaces, action, f"{name}.actions[{step}]")
    if sets is None:
        return
    if not isinstance(spaces.actions, DiscreteActions):
        raise InvalidLabel(f"{name}.action_sets", sets, "are for discrete actions only")
    if len(sets) != len(actions):
        raise InvalidLabel(f"{name}.action_sets: length", len(sets), f"must be {len(actions)}, one set an action")
    for step, (action, choices) in enumerate(zip(actions, sets, strict=True)):
        for choice in choices:
            _check_action(spaces, choice, f"{name}.action_sets[{step}]")
        if action not in choices:
            raise InvalidLabel(f"{name}.action_sets[{step}]", choices, f"must hold the action {action}")


def _check_action(spaces: Spaces, action: Action, name: str) -> None:
    space = spaces.actions
    if isinstance(space, DiscreteActions):
        if not isinstance(action, int) or not 0 <= action < space.n:
            raise InvalidLabel(name, action, f"must be an integer from 0 to {space.n - 1}")
        return
    _check_vector(space, action, name)


def _check_vector(space: BoxActions, action: Action, name: str) -> None:
    size = math.prod(space.shape)
    if isinstance(action, int) or len(action) != size:
        raise InvalidLabel(name, action, f"must be {size} numbers")
    if not all(math.isfinite(value) and space.low <= value <= space.high for value in action):
        raise InvalidLabel(name, action, f"must be finite and from {space.low} to {space.high}")
