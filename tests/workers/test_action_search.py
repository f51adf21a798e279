"""The search for a box action, on a toy arm whose answers are known."""

from functools import partial
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from workers.action_search import ActionSearch, moved
from workers.explainers import ReplayOrSearch, explainer_of
from workers.recording import Known, Provenance, Recording
from workers.ridge_start import FEWEST, RidgeStart
from workers.simulators.base import Action, Observation, Simulator, State, Step
from workers.simulators.search_settings import SearchSettings

ACTION = np.array([0.5, -0.25, 1.0, 1.0])


class ToyArm:
    """Three joints that answer bent, and a gripper of which only the sign counts: four numbers of motion for it."""

    search = SearchSettings(continuous=3, grips=(-1.0, 1.0))
    action_space = gym.spaces.Box(-1, 1, (4,), np.float32)
    observation_space = gym.spaces.Dict({"proprioception": gym.spaces.Box(-np.inf, np.inf, (7,), np.float32)})

    def __init__(self) -> None:
        self._x = np.zeros(7)
        self.steps = 0

    def reset(self, seed: int) -> Observation:
        self._x = np.full(7, float(seed))
        return self.observe()

    def step(self, action: Action) -> Step:
        self.advance(action)
        return Step(self.observe(), terminated=False, truncated=False)

    def observe(self) -> Observation:
        return self.numbers()

    def render(self) -> NDArray[np.uint8]:
        return np.zeros((8, 8, 3), np.uint8)

    def close(self) -> None:
        self._x = np.zeros(7)

    def state(self) -> State:
        return {"x": self._x.copy()}

    def restore(self, state: State) -> None:
        self._x = state["x"].copy()

    def advance(self, action: Action) -> None:
        numbers = np.asarray(action, np.float64)
        mixed = np.array([[1.0, 0.4, 0.0], [0.0, 1.0, -0.3], [0.2, 0.0, 1.0]]) @ numbers[:3]
        self._x = self._x + np.concatenate([np.tanh(mixed), np.full(4, np.sign(numbers[3]))])
        self.steps += 1

    def numbers(self) -> Observation:
        return {"proprioception": self._x.astype(np.float32)}

    def motion(self) -> NDArray[np.float64]:
        return self._x.copy()


def recorded(arm: ToyArm, action: NDArray[Any], start: float = 0.0) -> Recording:
    """One step."""
    arm.restore({"x": np.full(7, start)})
    seen, states = [arm.numbers()], [arm.state()]
    arm.advance(action.astype(np.float32))
    seen.append(arm.numbers())
    states.append(arm.state())
    return Recording(
        "toy", 0, *({name: np.stack([each[name] for each in steps]) for name in steps[0]} for steps in (seen, states))
    )


@pytest.fixture
def arm() -> ToyArm:
    return ToyArm()


@pytest.mark.parametrize("grip", [-1.0, 1.0])
def test_the_search_finds_the_action_also_at_a_bound_and_the_grip(arm: ToyArm, grip: float) -> None:
    action = np.array([*ACTION[:3], grip])
    found = ActionSearch(arm).find(recorded(arm, action), 0, np.zeros(4))
    np.testing.assert_allclose(found.action, action, atol=2e-3)
    assert found.residual < arm.search.tolerance


def test_what_no_action_reaches_is_no_answer(arm: ToyArm) -> None:
    recording = recorded(arm, ACTION)
    recording.states["x"][1, 0] += 3
    recording.observations["proprioception"][1, 0] += 3
    explainer = explainer_of(arm, lambda trajectory: Provenance(recording.states, {}), list)
    found = explainer.explain(recording, 0)
    assert found.actions == []
    assert found.residual > 1
    assert found.tolerance == arm.search.tolerance


def test_an_observation_that_is_no_number_is_no_answer(arm: ToyArm) -> None:
    recording = recorded(arm, ACTION)
    recording.observations["proprioception"][1, 0] = np.nan
    assert ActionSearch(arm).find(recording, 0, np.zeros(4)).residual == np.inf


def test_known_labels_bring_the_search_nearer(arm: ToyArm) -> None:
    rng, known = np.random.default_rng(0), list[Known]()
    for _ in range(FEWEST):
        action = rng.uniform(-0.6, 0.6, 4)
        known.append(Known(recorded(arm, action, rng.uniform(-1, 1)), [action.tolist()]))
    few, start = RidgeStart(arm, 4), RidgeStart(arm, 4)
    few.fit(known[:-1])
    start.fit(known)
    recording = recorded(arm, ACTION / 2)
    assert few.guess(recording, 0).tolist() == [0.0] * 4
    np.testing.assert_allclose(start.guess(recording, 0)[:3], ACTION[:3] / 2, atol=0.1)
    costs = list[int]()
    for labels in ([], known):
        explainer = ReplayOrSearch(arm, lambda trajectory: Provenance({}, {}), partial(list, labels))
        before = arm.steps
        assert explainer.search(recording, 0).actions
        costs.append(arm.steps - before)
    assert costs[1] <= costs[0]


def test_a_step_holds_what_presses_on_a_bound_and_leaves_the_other_numbers_exact() -> None:
    slopes, target = np.eye(3), np.array([2.0, 0.25, -0.5])
    action = np.array([1.0, 0.0, 0.0, -1.0])
    reached = moved(action, slopes @ action[:3] - target, slopes, damping=0.0)
    np.testing.assert_allclose(reached, [1.0, 0.25, -0.5, -1.0], atol=1e-6)


def test_an_action_space_that_is_neither_counted_nor_searched_is_refused() -> None:
    class Still:
        action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    with pytest.raises(ValueError, match=r"the actions of a Still, Box\(.*\), can be found in no way"):
        explainer_of(cast(Simulator, Still()), lambda trajectory: Provenance({}, {}), list)
