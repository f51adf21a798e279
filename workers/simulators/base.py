"""What every simulator offers: the protocol that collection, labeling and benchmarks are written against.

An episode, recorded so that any of its steps can be replayed later:

    simulator = make_simulator("minigrid", {"task": "key_delivery", "room_size": 6})
    behavior = make_behavior("mixture", simulator)
    rng = np.random.default_rng(0)
    observations, states, actions = [simulator.reset(seed=1)], [simulator.state()], []
    behavior.reset(rng)
    while True:
        action = behavior.act(simulator, rng)
        step = simulator.step(action)
        actions.append(action)
        observations.append(step.observation)
        states.append(simulator.state())
        if step.terminated or step.truncated:
            break
    trajectory = {name: np.stack([x[name] for x in observations]) for name in observations[0]}  # (T+1, ...)
    simulator.restore(states[3])  # step(actions[3]) now gives observations[4] again, bit for bit
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from workers.simulators.search_settings import SearchSettings

Observation = dict[str, NDArray[Any]]
"""Named streams, e.g. images and proprioception, each with the shape and dtype of its entry in `observation_space`."""

State = dict[str, NDArray[Any]]
"""Everything that decides the future, the random generator included, as plain arrays. The shapes and dtypes are
constant over a simulator's episodes, so that the states of a trajectory stack along time."""

Action = NDArray[Any] | int
"""One member of `action_space`: an integer of a Discrete space or an array of a Box."""


class SimulatorError(ValueError):
    """A simulator cannot do what was asked of it; the message is a sentence with the offending value."""


class OptionError(SimulatorError):
    """A name or an option that no simulator or behavior knows, or a value outside an option's range."""


class StateError(SimulatorError):
    """A state that does not belong to this simulator."""


class SimulatorUnavailable(SimulatorError):
    """A simulator that is not installed on this machine, or cannot draw here; the message names the command to run."""


class Step(NamedTuple):
    """What one action led to. After `terminated` or `truncated` nothing is stepped before a reset or a restore."""

    observation: Observation
    terminated: bool
    truncated: bool


class Simulator(Protocol):
    """A world with one agent that can be saved and restored exactly."""

    @property
    def observation_space(self) -> gym.spaces.Dict:
        """The space that every observation lies in."""

    @property
    def action_space(self) -> gym.Space[Any]:
        """The space that every action lies in."""

    def reset(self, seed: int) -> Observation:
        """Begins an episode. The seed alone decides it, whatever happened before."""

    def state(self) -> State:
        """A copy of the whole state, free of references to the simulator."""

    def restore(self, state: State) -> None:
        """Goes back to a state of this or of an equal simulator, in any process; the same actions then have the same
        outcomes, bit for bit. Allowed before `reset`. Raises StateError for a state of another kind of simulator."""

    def step(self, action: Action) -> Step:
        """Acts once. Raises SimulatorError for an action outside `action_space`."""

    def observe(self) -> Observation:
        """The observation of the current state, which it does not change."""

    def render(self) -> NDArray[np.uint8]:
        """A picture of the current state for people, (H, W, 3) RGB; H and W are constant."""

    def close(self) -> None:
        """Frees what the simulator holds; harmless when repeated."""


@runtime_checkable
class SearchableSimulator(Simulator, Protocol):
    """A simulator whose actions are boxes, and of which the action behind a recorded step can be searched for."""

    @property
    def search(self) -> SearchSettings:
        """What a search has to know."""

    def advance(self, action: Action) -> None:
        """`step` without looking: pictures are most of its cost."""

    def numbers(self) -> Observation:
        """The streams of `observe` that are no pictures."""

    def motion(self) -> NDArray[np.float64]:
        """What the robot does at present, (m,), each number in units in which 1 is much; an action changes it
        gradually."""


@runtime_checkable
class ArrangedSimulator(Simulator, Protocol):
    """A simulator that can tell where everything is, whatever its observations show of that."""

    def arrangement(self) -> Observation:
        """What decides how to act in the current state, as vectors."""


class Behavior(Protocol):
    """Chooses actions in a simulator's current state. All chance comes from the generator it is handed."""

    def reset(self, rng: np.random.Generator) -> None:
        """Begins an episode; called once after the simulator's reset and before the first `act`."""

    def act(self, simulator: Simulator, rng: np.random.Generator) -> Action:
        """The next action. It may read the simulator's state and must leave the simulator unchanged."""


@runtime_checkable
class RememberingBehavior(Behavior, Protocol):
    """A behavior that remembers more than its episode."""

    @property
    def memory(self) -> list[int]:
        """All that decides, with simulator and generator, what it does in the episodes to come."""

    def recall(self, memory: list[int]) -> None:
        """Goes on as the behavior that had this memory."""


def check_state(state: State, expected: Mapping[str, tuple[tuple[int, ...], str]]) -> None:
    """Raises StateError unless `state` has exactly the arrays of `expected`, a map from names to (shape, dtype)."""
    if state.keys() != expected.keys():
        raise StateError(f"A state needs the arrays {sorted(expected)}, but this one has {sorted(state)}.")
    for name, (shape, dtype) in expected.items():
        array = state[name]
        if array.shape != shape or array.dtype != np.dtype(dtype):
            raise StateError(f"State {name!r} must be {dtype} {shape}, but it is {array.dtype} {array.shape}.")


def check_finite(state: State) -> None:
    """Raises StateError where an array of `state` holds a number that is none."""
    for name, array in state.items():
        if not np.isfinite(array).all():
            raise StateError(f"State {name!r} holds a number that is not finite, at {_first_bad(array)}.")


def _first_bad(array: NDArray[Any]) -> list[int]:
    return cast(list[int], np.argwhere(~np.isfinite(array))[0].tolist())
