"""What api_schemas says twice is what simulators and strategies say themselves."""

import itertools
from typing import get_args

import gymnasium as gym
import pytest
from pydantic import ValidationError

from api_schemas.environments import (
    SIMULATOR_BEHAVIORS,
    SIMULATOR_SPACES,
    BoxActions,
    DiscreteActions,
    MiniGridOptions,
    Spaces,
    Stream,
)
from api_schemas.models import ModelKind
from api_schemas.strategies import (
    BATCH_RULE_NAMES,
    CATALOG,
    COLD_START_STRATEGY,
    DEFAULT_BATCH_RULE,
    DEFAULT_STRATEGY,
    PRIVILEGED,
    STRATEGY_NAMES,
)
from models.acquisition import BATCH_RULES, EXPLORING, STRATEGIES
from models.acquisition.base import Models
from models.network import KINDS
from workers.simulators import minigrid
from workers.simulators.base import OptionError
from workers.simulators.catalog import SIMULATORS, behavior_names, make_simulator

SIZES = [{"room_size": 6}, {"room_size": 8}, {"room_size": 8, "objects": 14, "noisy_tiles": 4}, {}]


@pytest.mark.parametrize("options", SIZES)
def test_spaces_are_those_of_the_simulator(options: dict[str, object]) -> None:
    simulator = make_simulator("minigrid", options)
    spaces = SIMULATOR_SPACES["minigrid"](options)
    expected = {
        name: Stream(dtype="uint8", shape=space.shape or (), high=tuple(size - 1 for size in minigrid.CHANNEL_SIZES))
        for name, space in simulator.observation_space.items()
    }
    assert spaces.observations == expected
    assert {str(space.dtype) for space in simulator.observation_space.values()} == {"uint8"}
    assert isinstance(simulator.action_space, gym.spaces.Discrete)
    assert isinstance(spaces.actions, DiscreteActions)
    assert spaces.actions.n == simulator.action_space.n
    assert spaces.actions.names == minigrid.ACTION_NAMES
    assert spaces.actions.groups == {"movement": tuple(minigrid.MOVEMENT), "interaction": tuple(minigrid.INTERACTION)}
    simulator.close()


def test_both_know_the_same_simulators_and_behaviors() -> None:
    assert set(SIMULATOR_SPACES) == set(SIMULATOR_BEHAVIORS) == set(SIMULATORS)
    for name, behaviors in SIMULATOR_BEHAVIORS.items():
        assert sorted(behaviors) == sorted(behavior_names(name))


def test_both_take_and_refuse_the_same_options() -> None:
    assert MiniGridOptions().model_dump() == vars(minigrid.MiniGridOptions())
    values = itertools.product(["any", "ball_delivery", "chess"], [5, 6, 7, 8], [2, 3, 4, 14, 15], [0, 4, 5], [0, 1])
    for task, room_size, objects, noisy_tiles, max_steps in values:
        options: dict[str, object] = {
            "task": task,
            "room_size": room_size,
            "objects": objects,
            "noisy_tiles": noisy_tiles,
            "max_steps": max_steps,
        }
        assert _taken_here(options) == _taken_there(options), options


def _taken_here(options: dict[str, object]) -> bool:
    try:
        MiniGridOptions.model_validate(options)
    except ValidationError:
        return False
    return True


def _taken_there(options: dict[str, object]) -> bool:
    try:
        minigrid.MiniGridOptions.parse(options)
    except OptionError:
        return False
    return True


def test_strategies_are_those_of_the_science() -> None:
    assert tuple(strategy.name for strategy in CATALOG) == STRATEGY_NAMES
    assert set(STRATEGY_NAMES) == set(STRATEGIES)
    for strategy in CATALOG:
        implemented = STRATEGIES[strategy.name]
        assert strategy.privileged == implemented.privileged
        assert set(strategy.needs) == implemented.needs
        assert set(strategy.needs) <= set(Models.__dataclass_fields__)
    assert {DEFAULT_STRATEGY, COLD_START_STRATEGY} <= set(STRATEGY_NAMES) - PRIVILEGED
    assert set(BATCH_RULE_NAMES) == set(BATCH_RULES) >= {DEFAULT_BATCH_RULE}
    assert not STRATEGIES[COLD_START_STRATEGY].needs
    assert {strategy.name for strategy in CATALOG if strategy.explores} == set(EXPLORING)


def test_a_box_of_seven_joints_is_a_space() -> None:
    spaces = Spaces(observations={"x": Stream(dtype="float32", shape=(3,))}, actions=BoxActions(shape=(7,)))
    assert Spaces.model_validate_json(spaces.model_dump_json()) == spaces


def test_the_registry_tells_every_kind_of_network() -> None:
    assert set(get_args(ModelKind)) == {*KINDS, "ensemble"}
