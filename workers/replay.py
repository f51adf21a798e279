"""Labels by replay: a behavior acts again where it acted, and the simulator says whether that led to what was recorded.

The simulator is exact, so going through the recorded states is the run itself; only what is labeled need be stepped.
"""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from workers.recording import Provenance, Provenances, Recording
from workers.simulators.base import Behavior, OptionError, SearchableSimulator, Simulator
from workers.simulators.catalog import make_behavior

Behaviors = Callable[[str, Simulator], Behavior]
"""A behavior by its name, for a simulator. Raises OptionError for a name of none."""


class Replay:
    """Actions of whole trajectories, by the behavior, the states and the generator that their provenance tells of."""

    def __init__(
        self, simulator: SearchableSimulator, provenances: Provenances, behaviors: Behaviors = make_behavior
    ) -> None:
        self._simulator, self._provenances, self._behaviors = simulator, provenances, behaviors
        self._played: dict[str, list[Any]] = {}  # by trajectory; empty where there is nothing to replay

    def action(self, recording: Recording, step: int) -> NDArray[Any] | None:
        """The action of a step, where the behavior's own leads from its state to exactly the recorded one and to what
        was observed; None where it does not, or where no behavior is told of."""
        if recording.trajectory not in self._played:
            self._played[recording.trajectory] = self._play(self._provenances(recording.trajectory))
        actions = self._played[recording.trajectory]
        action = actions[recording.start + step] if actions else None
        return action if action is not None and leads(self._simulator, recording, step, action) else None

    def _play(self, provenance: Provenance) -> list[Any]:
        """What the behavior does in each state but the last."""
        behavior, rng = self._behavior(provenance), np.random.default_rng()
        if behavior is None:
            return []
        rng.bit_generator.state = cast(dict[str, Any], provenance.told["generator"])
        behavior.reset(rng)
        actions = []
        for step in range(len(next(iter(provenance.states.values()))) - 1):
            self._simulator.restore({name: array[step] for name, array in provenance.states.items()})
            actions.append(behavior.act(self._simulator, rng))
        return actions

    def _behavior(self, provenance: Provenance) -> Behavior | None:
        if "generator" not in provenance.told:  # what was collected by older versions
            return None
        try:
            return self._behaviors(str(provenance.told["behavior"]), self._simulator)
        except OptionError:  # one that this version does not have
            return None


def leads(simulator: SearchableSimulator, recording: Recording, step: int, action: Any) -> bool:
    """Whether an action leads to the recorded state and to the observed numbers, bit for bit. Pictures are drawn of the
    state, and differ in grey levels between machines: they are not compared."""
    simulator.restore(recording.state(step))
    simulator.advance(action)
    reached, observed = {**simulator.state(), **simulator.numbers()}, recording.observed(step + 1)
    recorded = {**recording.state(step + 1), **{name: observed[name] for name in simulator.numbers()}}
    return all(np.array_equal(reached[name], array) for name, array in recorded.items())
