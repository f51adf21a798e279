"""Policies at work, on a toy arm and by replay: what they see, and that the same states and chance give the same."""

import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from models import checkpoints
from models.policies.diffusion import DiffusionPolicy, DiffusionPolicyConfig
from models.policies.noise import training_scheduler
from models.spaces import BoxAction, Spaces, StreamSpec
from workers.policies import PolicyBehavior, look, policy_of, rolled_out
from workers.simulators.base import Action, Observation, Simulator, SimulatorError, SimulatorUnavailable, State, Step

SPACES = Spaces({"place": StreamSpec((2,), "float32")}, BoxAction(-1.0, 1.0, (7,)))
CONFIG = DiffusionPolicyConfig(chunk=4, executed=3, channels=8, features=16)


class Place:
    """A point that actions push; it tells where it is beside what it observes, and counts how often it was asked."""

    observation_space = gym.spaces.Dict({"nothing": gym.spaces.Box(0, 1, (1,), np.float32)})
    action_space = gym.spaces.Box(-1, 1, (7,), np.float32)

    def __init__(self) -> None:
        self._x, self.asked = np.zeros(2), 0

    def reset(self, seed: int) -> Observation:
        self._x = np.full(2, float(seed))
        return self.observe()

    def state(self) -> State:
        return {"x": self._x.copy()}

    def restore(self, state: State) -> None:
        self._x = state["x"].copy()

    def step(self, action: Action) -> Step:
        self._x = self._x + np.asarray(action, np.float64)[:2]
        return Step(self.observe(), terminated=False, truncated=False)

    def observe(self) -> Observation:
        return {"nothing": np.zeros(1, np.float32)}

    def arrangement(self) -> Observation:
        self.asked += 1
        return {"place": self._x.astype(np.float32)}

    def render(self) -> NDArray[np.uint8]:
        return np.zeros((8, 8, 3), np.uint8)

    def close(self) -> None:
        self._x = np.zeros(2)


@pytest.fixture(scope="module")
def weights() -> bytes:
    return checkpoints.save(DiffusionPolicy(SPACES, CONFIG, torch.Generator().manual_seed(0)))


def acted(behavior: Any, simulator: Place, steps: int, seed: int) -> tuple[list[State], list[NDArray[np.float32]]]:
    """An episode of a behavior: the states before each action, and the actions."""
    rng, states, actions = np.random.default_rng(seed), [], []
    simulator.reset(1)
    behavior.reset(rng)
    for _ in range(steps):
        states.append(simulator.state())
        actions.append(behavior.act(simulator, rng))
        simulator.step(actions[-1])
    return states, actions


@pytest.mark.parametrize("make", [rolled_out, lambda weights: PolicyBehavior(policy_of(weights))])
def test_restored_one_by_one_the_same_states_have_the_same_actions(weights: bytes, make: Any) -> None:
    simulator = Place()
    states, actions = acted(make(weights), simulator, 10, seed=4)
    again, rng = make(weights), np.random.default_rng(4)
    again.reset(rng)
    for state, action in zip(states, actions, strict=True):
        simulator.restore(state)
        assert np.array_equal(again.act(simulator, rng), action)
        assert np.array_equal(simulator.state()["x"], state["x"])
    _, others = acted(make(weights), simulator, 10, seed=5)
    assert not np.array_equal(others, actions)


def test_an_episode_forgets_the_one_before(weights: bytes) -> None:
    behavior = PolicyBehavior(policy_of(weights))
    _, first = acted(behavior, Place(), 5, seed=4)  # ends in the middle of a chunk
    _, second = acted(behavior, Place(), 5, seed=4)
    assert np.array_equal(first, second)


def test_a_chunk_is_made_of_the_last_two_places_and_only_its_first_actions_are_taken(weights: bytes) -> None:
    policy, simulator = policy_of(weights).double(), Place()
    states, actions = acted(PolicyBehavior(policy_of(weights)), simulator, 7, seed=4)
    chance = torch.Generator().manual_seed(int(np.random.default_rng(4).integers(2**63)))
    places = [torch.from_numpy(state["x"].astype(np.float32)) for state in states]
    for start, before in ((0, 0), (3, 2), (6, 5)):
        chunk = policy.sample({"place": torch.stack((places[before], places[start]))[None]}, chance)[0]
        taken = torch.from_numpy(np.stack(actions[start : start + 3]))
        assert torch.equal(chunk[: len(taken)].float(), taken)
    assert simulator.asked == 5  # not at every step: looking may mean to draw two pictures


def test_the_number_of_threads_does_not_change_an_action(weights: bytes) -> None:
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(acted(PolicyBehavior(policy_of(weights)), Place(), 6, seed=4)[1])
    torch.set_num_threads(1)
    assert np.array_equal(found[0], found[1])


def test_a_policy_of_images_sees_what_is_observed() -> None:
    assert look(Place(), "images") == {"nothing": np.zeros(1)}
    assert look(Place(), "state")["place"].tolist() == [0, 0]
    with pytest.raises(SimulatorError, match="A Blind does not tell where everything is"):
        look(blind(), "state")


def test_a_missing_package_is_told_with_the_command_that_installs_it(
    weights: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    training_scheduler.cache_clear()
    monkeypatch.setitem(sys.modules, "diffusers.schedulers.scheduling_ddpm", None)
    with pytest.raises(
        SimulatorUnavailable, match=r"Package 'diffusers' cannot be imported .* Run `make setup-robots`"
    ):
        rolled_out(weights)


def test_bytes_that_are_no_policy_are_refused() -> None:
    with pytest.raises(checkpoints.CheckpointError, match="truncated or foreign"):
        rolled_out(b"nothing")


def blind() -> Simulator:
    methods = {name: value for name, value in vars(Place).items() if name != "arrangement"}
    made: Simulator = type("Blind", (), methods)()
    return made
