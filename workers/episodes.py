"""Episodes: what a behavior does in a simulator, and which of its transitions are worth a label by action."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.explanation import explain
from workers.simulators.base import Behavior, Simulator

REPEATS = 1000  # episodes in a row that were seen before: the simulator has nothing new to show


@dataclass(frozen=True)
class Episode:
    """Observations and states (T + 1, ...), and the T actions that led through them.

    actions: integers of a discrete space, or arrays of a box. seed: the simulator's. generator: the state of the
    behavior's generator when the episode began, as numpy tells it.
    """

    observations: dict[str, NDArray[Any]]
    states: dict[str, NDArray[Any]]
    actions: list[Any]
    seed: int
    generator: dict[str, Any]

    @property
    def transitions(self) -> int:
        """T."""
        return len(self.actions)

    def explained(self, simulator: Simulator, start: int) -> list[int]:
        """All actions that lead from the state at `start` to what was observed next."""
        state = {name: array[start] for name, array in self.states.items()}
        observed = {name: stream[start + 1] for name, stream in self.observations.items()}
        return explain(simulator, state, observed)[0]


def new_episodes(
    simulator: Simulator,
    behavior: Behavior,
    transitions: int,
    seed: int,
    known: Callable[[Episode], bool] = lambda episode: False,
    on_repeat: Callable[[int, int], None] = lambda left, repeats: None,
    on_step: Callable[[], None] = lambda: None,
) -> Iterator[Episode]:
    """Episodes of `transitions` transitions in all, decided by the seed; none twice, and none that is `known`.

    Ends early where the simulator has nothing new to show. on_repeat: told the transitions left and how many episodes
    in a row were seen before. on_step: called after every step, as a robot's episode takes long. Both may raise to
    stop.
    """
    rng = np.random.default_rng(seed)
    seen: set[bytes] = set()
    left, repeats = transitions, 0
    while left > 0 and repeats < REPEATS:
        episode = _episode(simulator, behavior, rng, left, on_step)
        digest = _digest(episode)
        if digest in seen or known(episode):
            repeats += 1
            on_repeat(left, repeats)
            continue
        seen.add(digest)
        left, repeats = left - episode.transitions, 0
        yield episode


class Quota:
    """How many effective transitions of each action are still to be labeled.

    A transition is effective when its action alone explains it: what happens by itself, like a flickering tile, has
    every idle action as an explanation. Nothing is counted where no labels are asked for, as of boxes none can be.
    """

    def __init__(self, simulator: Simulator, names: Sequence[str], per_action: int) -> None:
        self._simulator, self._names, self.per_action = simulator, names, per_action
        self.taken: Counter[str] = Counter()

    @property
    def met(self) -> bool:
        """Every action has its share; never true where no labels were asked for."""
        return self.per_action > 0 and not self.missing()

    def missing(self) -> dict[str, int]:
        """By action, how many transitions are still wanted."""
        short = {name: self.per_action - self.taken[name] for name in self._names}
        return {name: number for name, number in short.items() if number > 0}

    def take(self, episode: Episode) -> list[int]:
        """Starts of the transitions of this episode to label: effective ones of actions that are still wanted."""
        if not self.per_action:
            return []
        starts = []
        for start, action in enumerate(episode.actions):
            name = self._names[action]
            if self.taken[name] < self.per_action and episode.explained(self._simulator, start) == [action]:
                self.taken[name] += 1
                starts.append(start)
        return starts


def _episode(
    simulator: Simulator, behavior: Behavior, rng: np.random.Generator, most: int, on_step: Callable[[], None]
) -> Episode:
    """The next episode, cut after `most` transitions so that a collection is as long as was asked for."""
    seed, generator = int(rng.integers(2**31)), dict(rng.bit_generator.state)
    observations, states = [simulator.reset(seed)], [simulator.state()]
    actions: list[Any] = []
    behavior.reset(rng)
    while len(actions) < most:
        action = behavior.act(simulator, rng)
        step = simulator.step(action)
        observations.append(step.observation)
        states.append(simulator.state())
        actions.append(int(action) if np.ndim(action) == 0 else action)
        on_step()
        if step.terminated or step.truncated:
            break
    return Episode(_stacked(observations), _stacked(states), actions, seed, generator)


def _digest(episode: Episode) -> bytes:
    """Equal observations, equal digest."""
    digest = hashlib.sha256()
    for name in sorted(episode.observations):
        digest.update(episode.observations[name].tobytes())
    return digest.digest()


def _stacked(steps: list[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """T + 1 dicts of arrays to one dict of arrays (T + 1, ...)."""
    return {name: np.stack([step[name] for step in steps]) for name in steps[0]}
