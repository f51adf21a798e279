"""What every simulator of the catalog promises. A new simulator is one more entry of CASES."""

import io
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from workers.simulators.base import Action, Observation, Simulator, State, StateError
from workers.simulators.catalog import SIMULATORS, make_simulator

CASES: dict[str, tuple[str, dict[str, object]]] = {
    "minigrid": ("minigrid", {}),
    "minigrid-large-noisy": ("minigrid", {"room_size": 8, "objects": 14, "noisy_tiles": 4}),
}

REPLAY = """
import json
import sys
import numpy as np
from workers.simulators.catalog import make_simulator
folder, name, options = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
simulator = make_simulator(name, options)
simulator.restore(dict(np.load(folder + "/state.npz")))
steps = [simulator.step(action) for action in np.load(folder + "/actions.npy")]
np.savez(folder + "/future.npz", **{k: np.stack([s.observation[k] for s in steps]) for k in steps[0].observation})
"""


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> tuple[str, dict[str, object]]:
    return CASES[request.param]


@pytest.fixture
def simulator(case: tuple[str, dict[str, object]]) -> Iterator[Simulator]:
    made = make_simulator(*case)
    yield made
    made.close()


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
        assert {name for name, _ in CASES.values()} == set(SIMULATORS)

    def test_observations_lie_in_the_observation_space(self, simulator: Simulator) -> None:
        observations = [simulator.reset(0), *_play(simulator, _actions(simulator, 40)), simulator.observe()]
        assert all(simulator.observation_space.contains(observation) for observation in observations)

    def test_observing_returns_the_last_observation_in_new_arrays(self, simulator: Simulator) -> None:
        simulator.reset(0)
        last = _play(simulator, _actions(simulator, 20))[-1]
        _assert_equal([last], [simulator.observe()])
        for array in simulator.observe().values():
            array[...] = 1
        _assert_equal([last], [simulator.observe()])

    def test_a_seed_decides_the_episode(self, simulator: Simulator) -> None:
        actions = _actions(simulator, 60)
        first = [simulator.reset(5), *_play(simulator, actions)]
        _play(simulator, _actions(simulator, 3)[:1])
        second = [simulator.reset(5), *_play(simulator, actions)]
        _assert_equal(first, second)

    def test_seeds_lead_to_different_episodes(self, simulator: Simulator) -> None:
        starts = [simulator.reset(seed) for seed in range(4)]
        assert len({b"".join(array.tobytes() for array in start.values()) for start in starts}) > 1

    def test_a_restored_state_has_the_same_future(self, simulator: Simulator) -> None:
        simulator.reset(1)
        _play(simulator, _actions(simulator, 5))
        state, now, actions = simulator.state(), simulator.observe(), _actions(simulator, 60)
        future = _play(simulator, actions)
        simulator.reset(2)
        simulator.restore(_through_bytes(state))
        _assert_equal([now, *future], [simulator.observe(), *_play(simulator, actions)])

    def test_a_fresh_simulator_continues_from_a_state(
        self, simulator: Simulator, case: tuple[str, dict[str, object]]
    ) -> None:
        simulator.reset(1)
        state, actions = simulator.state(), _actions(simulator, 60)
        future = _play(simulator, actions)
        fresh = make_simulator(*case)
        fresh.restore(_through_bytes(state))
        _assert_equal(future, _play(fresh, actions))
        fresh.close()

    def test_another_process_continues_from_a_state(
        self, simulator: Simulator, case: tuple[str, dict[str, object]], tmp_path: Path
    ) -> None:
        simulator.reset(1)
        np.savez(tmp_path / "state.npz", **cast(Any, simulator.state()))
        actions = _actions(simulator, 30)
        future = _play(simulator, actions)
        np.save(tmp_path / "actions.npy", np.array(actions[: len(future)]))
        subprocess.run(
            [sys.executable, "-c", REPLAY, str(tmp_path), case[0], json.dumps(case[1])], check=True, timeout=60
        )
        replayed = np.load(tmp_path / "future.npz")
        for name in future[0]:
            np.testing.assert_array_equal(replayed[name], np.stack([observation[name] for observation in future]))

    def test_restoring_gives_back_the_whole_state(self, simulator: Simulator) -> None:
        simulator.reset(1)
        state = simulator.state()
        _play(simulator, _actions(simulator, 9))
        simulator.restore(state)
        _assert_equal([state], [simulator.state()])

    def test_states_are_plain_arrays_that_stack_along_time(self, simulator: Simulator) -> None:
        simulator.reset(0)
        states = [simulator.state()]
        for action in _actions(simulator, 20):
            simulator.step(action)
            states.append(simulator.state())
        assert all(state.keys() == states[0].keys() for state in states)
        for name, first in states[0].items():
            assert {(state[name].shape, state[name].dtype) for state in states} == {(first.shape, first.dtype)}
            assert first.dtype.kind in "biuf"
            assert np.stack([state[name] for state in states]).shape == (21, *first.shape)

    def test_a_saved_state_is_not_changed_by_later_steps(self, simulator: Simulator) -> None:
        simulator.reset(0)
        state = simulator.state()
        copy = {name: array.copy() for name, array in state.items()}
        _play(simulator, _actions(simulator, 30))
        _assert_equal([copy], [state])

    def test_the_picture_is_rgb_of_constant_size(self, simulator: Simulator) -> None:
        simulator.reset(0)
        before = simulator.render()
        _play(simulator, _actions(simulator, 10))
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

    def test_closing_twice_is_harmless(self, simulator: Simulator) -> None:
        simulator.close()
        simulator.close()
