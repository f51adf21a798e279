"""What api_schemas says twice is what simulators and strategies say themselves."""

import itertools
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from typing import get_args

import gymnasium as gym
import pytest
from pydantic import ValidationError

from api_schemas.base import Schema
from api_schemas.environments import (
    GRIPPER,
    SIMULATOR_BEHAVIORS,
    SIMULATOR_SPACES,
    BoxActions,
    DiscreteActions,
    ManiSkillOptions,
    MiniGridOptions,
    RobosuiteOptions,
    Spaces,
    Stream,
    takes_robot,
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
from models.families import ROBOT
from models.network import KINDS
from workers.data import model_spaces
from workers.simulators import maniskill, minigrid, robosuite
from workers.simulators.base import OptionError, SimulatorUnavailable
from workers.simulators.catalog import SIMULATORS, behavior_names, make_simulator
from workers.simulators.robot_options import RobotOptions

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


ROBOTS: dict[str, tuple[type[Schema], dict[str, int]]] = {
    "robosuite": (RobosuiteOptions, robosuite.HORIZONS),
    "maniskill": (ManiSkillOptions, maniskill.HORIZONS),
}


@pytest.mark.parametrize("cameras", [True, False])
@pytest.mark.parametrize(("name", "task"), [(name, task) for name in ROBOTS for task in ROBOTS[name][1]])
def test_a_robots_spaces_are_those_of_the_simulator(name: str, task: str, cameras: bool) -> None:
    options = {"task": task, "cameras": cameras}
    spaces = SIMULATOR_SPACES[name](options)
    try:
        simulator = make_simulator(name, options)
    except SimulatorUnavailable as error:
        pytest.skip(str(error))
    streams = {
        key: Stream.model_validate({"dtype": str(space.dtype), "shape": space.shape})
        for key, space in simulator.observation_space.items()
    }
    assert spaces.observations == streams
    space = simulator.action_space
    assert isinstance(space, gym.spaces.Box)
    low, high = float(space.low.min()), float(space.high.max())
    assert spaces.actions == BoxActions(shape=space.shape, low=low, high=high, signs=(GRIPPER,))
    simulator.close()


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robots_options_are_those_of_the_simulator(name: str) -> None:
    schema, horizons = ROBOTS[name]
    assert get_args(schema.model_fields["task"].annotation) == tuple(horizons)
    parsed = RobotOptions.parse(name, horizons, {})
    assert schema().model_dump() == {**vars(parsed), "horizon": None}
    values = itertools.product(
        [*horizons, "chess", 1], [True, False, 1, "true"], [None, 0, 1, 10**6, 10**6 + 1, 2.0, "9"]
    )
    for task, cameras, horizon in values:
        options: dict[str, object] = {"task": task, "cameras": cameras, "horizon": horizon}
        taken = _is_taken(schema.model_validate, options)
        assert taken == _is_taken(lambda o: RobotOptions.parse(name, horizons, o), options), options
    assert not _is_taken(schema.model_validate, {"colour": "red"})


def _is_taken(parse: Callable[[Mapping[str, object]], object], options: Mapping[str, object]) -> bool:
    try:
        parse(options)
    except (ValidationError, OptionError):
        return False
    return True


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
        taken = _is_taken(MiniGridOptions.model_validate, options)
        assert taken == _is_taken(minigrid.MiniGridOptions.parse, options), options


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


STATE, IMAGE = Stream(dtype="float32", shape=(3,)), Stream(dtype="uint8", shape=(16, 16, 3))


@pytest.mark.parametrize(
    ("streams", "actions", "taken"),
    [
        ({"arm": STATE}, BoxActions(shape=(2,)), True),
        ({"arm": STATE, "front": IMAGE, "wrist": IMAGE}, BoxActions(shape=(2,), low=-3.0, high=5.0, signs=(1,)), True),
        ({"front": IMAGE}, BoxActions(shape=(2,)), True),
        ({"front": IMAGE, "wrist": Stream(dtype="uint8", shape=(32, 32, 3))}, BoxActions(shape=(2,)), False),
        ({"front": Stream(dtype="uint8", shape=(24, 24, 3))}, BoxActions(shape=(2,)), False),
        ({"front": Stream(dtype="uint8", shape=(4, 4, 3))}, BoxActions(shape=(2,)), False),
        ({"front": Stream(dtype="uint8", shape=(16, 16, 1))}, BoxActions(shape=(2,)), False),
        ({"front": Stream(dtype="float32", shape=(16, 16, 3))}, BoxActions(shape=(2,)), False),
        ({"arm": Stream(dtype="int64", shape=(3,))}, BoxActions(shape=(2,)), False),
        ({"arm": Stream(dtype="float32", shape=(3, 3))}, BoxActions(shape=(2,)), False),
        ({"arm": Stream(dtype="float64", shape=())}, BoxActions(shape=(2,)), False),
        ({"arm": STATE}, BoxActions(shape=(2, 2)), False),
        ({"arm": STATE}, BoxActions(shape=(2,), low=1.0, high=1.0), False),
        ({"arm": STATE}, DiscreteActions(n=3), False),
    ],
)
def test_the_robot_family_takes_what_it_says_itself(
    streams: Mapping[str, Stream], actions: BoxActions | DiscreteActions, taken: bool
) -> None:
    spaces = Spaces(observations=dict(streams), actions=actions)
    assert takes_robot(spaces) == taken
    with nullcontext() if taken else pytest.raises(ValueError, match=r"must (all )?be|takes"):
        ROBOT.check_spaces(model_spaces(spaces))


def test_the_registry_tells_every_kind_of_network() -> None:
    assert set(get_args(ModelKind)) == {*KINDS, "ensemble"}
