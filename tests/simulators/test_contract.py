"""What every simulator of the catalog promises. A new simulator is one more entry of CASES."""

import io
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pytest

from workers.simulators.base import Action, Observation, Simulator, SimulatorUnavailable, State, StateError
from workers.simulators.catalog import SIMULATORS, make_simulator


class Case(NamedTuple):
    """An environment, and how many steps its longest tests take: a robot's step costs a hundred of a room's."""

    simulator: str
    options: dict[str, object]
    steps: int = 60

    def make(self) -> Simulator:
        try:
            return make_simulator(self.simulator, self.options)
        except SimulatorUnavailable as error:
            pytest.skip(str(error))


CASES = {
    "any": Case("minigrid", {}),
    "key_delivery": Case("minigrid", {"task": "key_delivery"}),
    "ball_delivery": Case("minigrid", {"task": "ball_delivery", "room_size": 8, "objects": 14, "noisy_tiles": 4}),
    "object_matching": Case("minigrid", {"task": "object_matching"}),
    "Lift": Case("robosuite", {"task": "Lift"}, 8),
    "PickPlaceCan": Case("robosuite", {"task": "PickPlaceCan"}, 8),
    "NutAssemblySquare": Case("robosuite", {"task": "NutAssemblySquare"}, 8),
    "PullCube": Case("maniskill", {"task": "PullCube"}, 15),
    "PokeCube": Case("maniskill", {"task": "PokeCube"}, 15),
    "LiftPegUpright": Case("maniskill", {"task": "LiftPegUpright"}, 15),
}

REPLAY = """
import json
import sys
import numpy as np
from workers.simulators.catalog import make_simulator
folder, cases = sys.argv[1], json.loads(sys.argv[2])
for case, (name, options, _) in cases.items():
    simulator = make_simulator(name, options)
    simulator.restore(dict(np.load(f"{folder}/{case}-state.npz")))
    steps = [simulator.step(action) for action in np.load(f"{folder}/{case}-actions.npy")]
    future = {k: np.stack([step.observation[k] for step in steps]) for k in steps[0].observation}
    np.savez(f"{folder}/{case}-future.npz", **future)
    simulator.close()
"""


class Made:
    """The simulators of the cases, each made once: that takes a second, and no test may depend on what was before."""

    def __init__(self) -> None:
        self._made: dict[str, Simulator] = {}

    def __call__(self, case: str) -> Simulator:
        if case not in self._made:
            self._made[case] = CASES[case].make()
        return self._made[case]

    def close(self) -> None:
        for simulator in self._made.values():
            simulator.close()


@pytest.fixture(scope="module")
def made() -> Iterator[Made]:
    simulators = Made()
    yield simulators
    simulators.close()


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


@pytest.fixture
def simulator(case: Case, made: Made) -> Simulator:
    return made(next(name for name, each in CASES.items() if each is case))


def _actions(simulator: Simulator, count: int) -> list[Action]:
    simulator.action_space.seed(7)
    return [simulator.action_space.sample() for _ in range(count)]


def _play(simulator: Simulator, actions: list[Action]) -> list[Observation]:
    """Observations until the episode ends."""
    observations = []
    for action in actions:
        step = simulator.step(action)
        observations.append(step.observation)
        if step.terminated or step.truncated:
            break
    return observations


def _assert_equal(first: list[Observation], second: list[Observation]) -> None:
    assert len(first) == len(second) > 0
    for one, other in zip(first, second, strict=True):
        assert one.keys() == other.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])


def _through_bytes(state: State) -> State:
    """A state written and read as plain arrays, pickling forbidden."""
    buffer = io.BytesIO()
    np.savez(buffer, **cast(Any, state))
    buffer.seek(0)
    return dict(np.load(buffer, allow_pickle=False))


class TestContract:
    def test_every_simulator_of_the_catalog_is_tested(self) -> None:
        assert {case.simulator for case in CASES.values()} == set(SIMULATORS)

    def test_observations_lie_in_the_observation_space(self, simulator: Simulator, case: Case) -> None:
        observations = [simulator.reset(0), *_play(simulator, _actions(simulator, case.steps)), simulator.observe()]
        assert all(simulator.observation_space.contains(observation) for observation in observations)

    def test_observing_returns_the_last_observation_in_new_arrays(self, simulator: Simulator, case: Case) -> None:
        simulator.reset(0)
        last = _play(simulator, _actions(simulator, case.steps // 3))[-1]
        _assert_equal([last], [simulator.observe()])
        for array in simulator.observe().values():
            array[...] = 1
        _assert_equal([last], [simulator.observe()])

    def test_a_seed_decides_the_episode(self, simulator: Simulator, case: Case) -> None:
        actions = _actions(simulator, case.steps)
        first = [simulator.reset(5), *_play(simulator, actions)]
        _play(simulator, _actions(simulator, 3)[:1])
        second = [simulator.reset(5), *_play(simulator, actions)]
        _assert_equal(first, second)

    def test_seeds_lead_to_different_episodes(self, simulator: Simulator) -> None:
        starts = [simulator.reset(seed) for seed in range(4)]
        assert len({b"".join(array.tobytes() for array in start.values()) for start in starts}) > 1

    def test_a_restored_state_has_the_same_future(self, simulator: Simulator, case: Case) -> None:
        simulator.reset(1)
        _play(simulator, _actions(simulator, 5))
        state, now, actions = simulator.state(), simulator.observe(), _actions(simulator, case.steps)
        future = _play(simulator, actions)
        simulator.reset(2)
        simulator.restore(_through_bytes(state))
        _assert_equal([now, *future], [simulator.observe(), *_play(simulator, actions)])

    def test_states_can_be_replayed_in_any_order(self, simulator: Simulator, case: Case) -> None:
        simulator.reset(1)
        states, actions = [simulator.state()], _actions(simulator, case.steps)
        for action in actions:
            simulator.step(action)
            states.append(simulator.state())
        for number in np.random.default_rng(0).permutation(len(actions)):
            simulator.restore(states[number])
            simulator.step(actions[number])
            _assert_equal([states[number + 1]], [simulator.state()])

    def test_a_fresh_simulator_continues_from_a_state(self, simulator: Simulator, case: Case) -> None:
        simulator.reset(1)
        state, actions = simulator.state(), _actions(simulator, case.steps)
        future = _play(simulator, actions)
        fresh = case.make()
        fresh.restore(_through_bytes(state))
        _assert_equal(future, _play(fresh, actions))
        fresh.close()
        fresh.close()  # harmless

    @pytest.mark.parametrize("name", SIMULATORS)
    def test_another_process_continues_from_a_state(self, name: str, made: Made, tmp_path: Path) -> None:
        cases = {key: case for key, case in CASES.items() if case.simulator == name}
        futures = {}
        for key, case in cases.items():
            simulator = made(key)
            simulator.reset(1)
            np.savez(tmp_path / f"{key}-state.npz", **cast(Any, simulator.state()))
            actions = _actions(simulator, case.steps)
            futures[key] = _play(simulator, actions)
            np.save(tmp_path / f"{key}-actions.npy", np.array(actions[: len(futures[key])]))
        subprocess.run([sys.executable, "-c", REPLAY, str(tmp_path), json.dumps(cases)], check=True, timeout=120)
        for key, future in futures.items():
            replayed = np.load(tmp_path / f"{key}-future.npz")
            for stream in future[0]:
                told = np.stack([observation[stream] for observation in future])
                np.testing.assert_array_equal(replayed[stream], told, err_msg=key)

    def test_restoring_gives_back_the_whole_state(self, simulator: Simulator) -> None:
        simulator.reset(1)
        state = simulator.state()
        _play(simulator, _actions(simulator, 9))
        simulator.restore(state)
        _assert_equal([state], [simulator.state()])

    def test_states_are_plain_arrays_that_stack_along_time(self, simulator: Simulator, case: Case) -> None:
        simulator.reset(0)
        states = [simulator.state()]
        for action in _actions(simulator, case.steps // 3):
            simulator.step(action)
            states.append(simulator.state())
        assert all(state.keys() == states[0].keys() for state in states)
        for name, first in states[0].items():
            assert {(state[name].shape, state[name].dtype) for state in states} == {(first.shape, first.dtype)}
            assert first.dtype.kind in "biuf"
            assert np.stack([state[name] for state in states]).shape == (len(states), *first.shape)

    def test_a_saved_state_is_not_changed_by_later_steps(self, simulator: Simulator) -> None:
        simulator.reset(0)
        state = simulator.state()
        copy = {name: array.copy() for name, array in state.items()}
        _play(simulator, _actions(simulator, 9))
        _assert_equal([copy], [state])

    def test_the_picture_is_rgb_of_constant_size(self, simulator: Simulator) -> None:
        simulator.reset(0)
        before = simulator.render()
        _play(simulator, _actions(simulator, 5))
        after = simulator.render()
        assert before.dtype == after.dtype == np.uint8
        assert before.ndim == 3
        assert before.shape[2] == 3
        assert before.shape == after.shape
        assert before.std() > 0

    def test_looking_changes_nothing(self, simulator: Simulator) -> None:
        simulator.reset(0)
        state = simulator.state()
        simulator.observe()
        simulator.render()
        _assert_equal([state], [simulator.state()])

    @pytest.mark.parametrize("spoil", ["missing", "shape", "dtype"])
    def test_a_foreign_state_is_refused_with_its_name(self, simulator: Simulator, spoil: str) -> None:
        simulator.reset(0)
        state: dict[str, Any] = dict(simulator.state())
        name = sorted(state)[0]
        array = state.pop(name)
        if spoil != "missing":
            state[name] = np.stack([array, array]) if spoil == "shape" else array.astype(np.complex64)
        with pytest.raises(StateError, match=name):
            simulator.restore(state)
