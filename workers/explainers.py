"""How the actions behind recorded steps are found: by trying all, where they can be counted, else by replay or search.

Which of the two follows from the simulator's action space; nothing here knows a simulator by name.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np

from workers.action_search import ActionSearch
from workers.explanation import explain
from workers.recording import Known, Provenances, Recording
from workers.replay import Behaviors, Replay, leads
from workers.ridge_start import RidgeStart
from workers.simulators.base import SearchableSimulator, Simulator
from workers.simulators.catalog import make_behavior

Actions = list[Any]  # integers, or lists of floats: as a label holds them


class Explained(NamedTuple):
    """All actions that are known to lead through a step, none where even the nearest one misses; how far that or the
    worst of them ended from what was observed, in any number of it, and how far it may."""

    actions: Actions
    residual: float
    tolerance: float = 0.0


class Explainer(Protocol):
    """Finds the actions of recorded steps in a simulator."""

    @property
    def is_exhaustive(self) -> bool:
        """Whether it finds all actions that explain a step, so that a label can bear the whole set."""

    def explain(self, recording: Recording, step: int) -> Explained:
        """The actions that lead through a step of a recording."""

    def confirm(self, recording: Recording, step: int, action: Any) -> Explained:
        """The same of a step whose action is known: `actions` holds it, or the simulator does not repeat itself."""


def explainer_of(
    simulator: Simulator,
    provenances: Provenances,
    known: Callable[[], Iterable[Known]],
    behaviors: Behaviors = make_behavior,
) -> Explainer:
    """The explainer that fits the simulator's actions. known: labels of the project, asked for where a search needs a
    start. Raises ValueError for an action space that it has no way for."""
    if isinstance(simulator.action_space, gym.spaces.Discrete):
        return Enumeration(simulator)
    if isinstance(simulator.action_space, gym.spaces.Box) and isinstance(simulator, SearchableSimulator):
        return ReplayOrSearch(simulator, provenances, known, behaviors)
    raise ValueError(f"the actions of a {type(simulator).__name__}, {simulator.action_space}, can be found in no way")


class Enumeration:
    """Tries every discrete action."""

    is_exhaustive = True

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator

    def explain(self, recording: Recording, step: int) -> Explained:
        """All of them."""
        return Explained(*explain(self._simulator, recording.state(step), recording.observed(step + 1)))

    def confirm(self, recording: Recording, step: int, action: Any) -> Explained:
        """All of them, if the known one is among them."""
        found = self.explain(recording, step)
        return found if action in found.actions else found._replace(actions=[])


class ReplayOrSearch:
    """Replays the behavior that was recorded; where there is none, or it led elsewhere, searches the box of actions."""

    is_exhaustive = False

    def __init__(
        self,
        simulator: SearchableSimulator,
        provenances: Provenances,
        known: Callable[[], Iterable[Known]],
        behaviors: Behaviors = make_behavior,
    ) -> None:
        self._simulator, self._known = simulator, known
        self._replay, self._search = Replay(simulator, provenances, behaviors), ActionSearch(simulator)
        self._start: RidgeStart | None = None

    def explain(self, recording: Recording, step: int) -> Explained:
        """One action: the behavior's own with residual 0, or the one that the search found."""
        action = self._replay.action(recording, step)
        return self.search(recording, step) if action is None else Explained([_told(action)], 0.0)

    def search(self, recording: Recording, step: int) -> Explained:
        """What the search finds, whatever behavior was recorded."""
        if self._start is None:
            self._start = RidgeStart(self._simulator, int(np.prod(self._simulator.action_space.shape or ())))
            self._start.fit(self._known())
        action, residual = self._search.find(recording, step, self._start.guess(recording, step))
        tolerance = self._simulator.search.tolerance
        return Explained([_told(action)] if residual <= tolerance else [], residual, tolerance)

    def confirm(self, recording: Recording, step: int, action: Any) -> Explained:
        """The action, if it leads to the recorded state again."""
        is_repeated = leads(self._simulator, recording, step, np.asarray(action, np.float32))
        return Explained([action] if is_repeated else [], 0.0 if is_repeated else np.inf)


def _told(action: Any) -> list[float]:
    return [float(number) for number in action]
