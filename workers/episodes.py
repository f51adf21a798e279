"""Episodes: what a behavior does in a simulator, one after the other, decided by a generator's state."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.explanation import explain
from workers.recording import stacked
from workers.simulators.base import Behavior, Simulator

DIGEST = 16  # bytes that stand for an episode: a checkpoint holds one for each
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

    def told_actions(self) -> list[Any]:
        """The actions as a label holds them: integers, or lists of floats."""
        return [action if isinstance(action, int) else action.tolist() for action in self.actions]

    def explained(self, simulator: Simulator, start: int) -> list[int]:
        """All discrete actions that lead from the state at `start` to what was observed next."""
        state = {name: array[start] for name, array in self.states.items()}
        observed = {name: stream[start + 1] for name, stream in self.observations.items()}
        return explain(simulator, state, observed)[0]


@dataclass
class Drawn:
    """What was drawn so far. With the generator's state it decides all episodes to come.

    seen: digests of its episodes' observations.
    """

    rng: np.random.Generator
    seen: set[bytes] = field(default_factory=set)
    trajectories: int = 0
    transitions: int = 0


@dataclass(frozen=True)
class Extent:
    """How much is to be drawn: one of the two."""

    transitions: int | None = None
    trajectories: int | None = None

    def longest(self, drawn: Drawn) -> float:
        """How many transitions the next episode may have; 0 where all is drawn."""
        done, of = self._counted(drawn)
        left = of - done
        return left if self.trajectories is None or left == 0 else np.inf

    def share(self, drawn: Drawn) -> float:
        """Of it that is drawn, from 0 to 1."""
        done, of = self._counted(drawn)
        return done / max(1, of)

    def told(self, drawn: Drawn) -> str:
        """The same in words."""
        done, of = self._counted(drawn)
        return f"{done} of {of} {'trajectories' if self.transitions is None else 'transitions'}"

    def _counted(self, drawn: Drawn) -> tuple[int, int]:
        """How much of how much."""
        if self.transitions is None:
            return drawn.trajectories, self.trajectories or 0
        return drawn.transitions, self.transitions


def new_episodes(simulator: Simulator, behavior: Behavior, transitions: int, seed: int) -> Iterator[Episode]:
    """Episodes of `transitions` transitions in all, decided by the seed; none twice."""
    return further_episodes(simulator, behavior, Extent(transitions), Drawn(np.random.default_rng(seed)))


def further_episodes(
    simulator: Simulator,
    behavior: Behavior,
    extent: Extent,
    drawn: Drawn,
    known: Callable[[Episode], bool] = lambda episode: False,
    on_repeat: Callable[[int], None] = lambda repeats: None,
    on_step: Callable[[], None] = lambda: None,
) -> Iterator[Episode]:
    """Episodes up to an extent, going on behind what was drawn, which is kept up to date; none twice, and none that is
    `known`. Where it is cut and goes on with an equal `drawn`, they are those of one run.

    Ends early where the simulator has nothing new to show. on_repeat: told how many episodes in a row were seen before.
    on_step: called after every step, as a robot's episode takes long. Both may raise to stop.
    """
    repeats = 0
    while (longest := extent.longest(drawn)) > 0 and repeats < REPEATS:
        episode = _episode(simulator, behavior, drawn.rng, longest, on_step)
        digest = _digest(episode)
        if digest in drawn.seen or known(episode):
            repeats += 1
            on_repeat(repeats)
            continue
        repeats = 0
        drawn.seen.add(digest)
        drawn.trajectories, drawn.transitions = drawn.trajectories + 1, drawn.transitions + episode.transitions
        yield episode


def _episode(
    simulator: Simulator, behavior: Behavior, rng: np.random.Generator, most: float, on_step: Callable[[], None]
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
    return Episode(stacked(observations), stacked(states), actions, seed, generator)


def _digest(episode: Episode) -> bytes:
    """Equal observations, equal digest of DIGEST bytes."""
    digest = hashlib.sha256()
    for name in sorted(episode.observations):
        digest.update(episode.observations[name].tobytes())
    return digest.digest()[:DIGEST]
