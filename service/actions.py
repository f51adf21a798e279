"""Actions of a label, held against the project's action space, or against the label that is there already."""

import math
from collections.abc import Sequence

from api_schemas.environments import BoxActions, DiscreteActions, Spaces
from api_schemas.errors import InvalidParam
from api_schemas.labels import Action
from service.errors import LONGEST, InvalidField, ServiceError

SHOWN = 5  # steps of two labels that differ


class InvalidLabel(InvalidField):
    """A label does not fit its segment or the project's action space."""


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


def _shown(value: object) -> str:
    """At most LONGEST characters of it."""
    text = str(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _content(step: object) -> str:
    """A step's action, or the set of actions that explain it, in whatever order they are named."""
    choices = step if isinstance(step, list) else [step]
    discrete = all(isinstance(choice, int) for choice in choices)
    return str(sorted(set(choices)) if discrete else choices)
