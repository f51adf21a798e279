"""Action-following score: how much of what sets the outcomes of actions apart a world model predicts.

In a state, pickup, toggle and swap lead to three observations. Every channel of every element in which two of them
differ is one difference that the action makes. A world model follows the action there when it predicts that channel
right under both. The score is the share of all differences in which it does:

    sum over states and pairs (a, b) of #{channels: y_a != y_b, p_a = y_a, p_b = y_b}
    ---------------------------------------------------------------------------------
             sum over states and pairs (a, b) of #{channels: y_a != y_b}

with y the simulator's next observation and p the world model's likeliest one. A model that ignores the action has 0, a
perfect one 1. The published score is the pairwise diversity of the predictions on correctly predicted channels over
that of the true outcomes; on channels that are right, predictions differ exactly where the outcomes do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.paper.minigrid.datasets import DataSpec, load_states
from models.segments import Observations
from models.world_models.base import WorldModel
from workers.simulators.base import Observation, Simulator, State
from workers.simulators.catalog import make_simulator
from workers.simulators.minigrid_rules import PICKUP, SWAP, TOGGLE

ACTIONS = (PICKUP, TOGGLE, SWAP)
STATES = 200


@dataclass(frozen=True)
class Outcomes:
    """now: observations (N, ...). after: what each of the A actions leads to, (N, A, ...)."""

    now: Observations
    after: Observations
    actions: tuple[int, ...] = ACTIONS


def outcomes(simulator: Simulator, states: Sequence[State], actions: tuple[int, ...] = ACTIONS) -> Outcomes:
    """Of each action in each state, by the simulator."""
    now, after = list[Observation](), list[list[Observation]]()
    for state in states:
        simulator.restore(state)
        now.append(simulator.observe())
        after.append([_reached(simulator, state, action) for action in actions])
    return Outcomes(
        {name: torch.from_numpy(np.stack([each[name] for each in now])) for name in now[0]},
        {
            name: torch.from_numpy(np.stack([[each[name] for each in of_state] for of_state in after]))
            for name in now[0]
        },
        actions,
    )


def load_outcomes(spec: DataSpec, folder: Path, count: int = STATES) -> Outcomes:
    """In `count` states of a set, evenly spaced; the set is made with its states where it is not there yet."""
    simulator = make_simulator("minigrid", spec.options)
    return outcomes(simulator, spread(load_states(replace(spec, states=True), folder), count))


@torch.inference_mode()
def action_following(world_model: WorldModel, test: Outcomes) -> float:
    """The score, 0 to 1. Raises ValueError where the actions make no difference in any state."""
    state = world_model.infer_state({name: stream.unsqueeze(1) for name, stream in test.now.items()})
    guesses = [
        world_model.observe(world_model.predict(state, torch.full((len(state),), action))) for action in test.actions
    ]
    differing, followed = 0, 0
    for name, after in test.after.items():
        right = [_channels(guess[name]) == _channels(after[:, place]) for place, guess in enumerate(guesses)]
        for one, other in combinations(range(len(test.actions)), 2):
            differs = _channels(after[:, one]) != _channels(after[:, other])
            differing += int(differs.sum())
            followed += int((differs & right[one] & right[other]).sum())
    if not differing:
        raise ValueError(f"The actions {test.actions} lead to the same in all {len(state)} states.")
    return followed / differing


def spread(states: Sequence[State], count: int) -> list[State]:
    """`count` of the states, evenly spaced; all where there are fewer."""
    places = np.unique(np.linspace(0, len(states) - 1, min(count, len(states))).round().astype(int))
    return [states[place] for place in places]


def _reached(simulator: Simulator, state: State, action: int) -> Observation:
    simulator.restore(state)
    return simulator.step(action).observation


def _channels(stream: Tensor) -> Tensor:
    """(N, ...) -> (N, channels)."""
    return stream.flatten(1)
