"""Dynamics Accuracy of a world model, and of a simulator that executes what inverse dynamics inferred."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from benchmarks.paper.minigrid.changes import accuracy, changes, without_tiles
from benchmarks.paper.minigrid.prediction_data import Room
from benchmarks.paper.runs import Json
from models.inverse_dynamics.base import ActionInference
from models.segments import Observations, SegmentBatch, first
from models.world_models.base import WorldModel
from workers.simulators.base import Simulator, State
from workers.simulators.minigrid_rules import INTERACTION

FRESH = " fresh"  # ends the name of a form whose simulator has another moment's chance
CHUNK = 512


def without_simulator(world_model: WorldModel, inverses: Mapping[str, ActionInference], test: SegmentBatch) -> Json:
    """What observations alone tell: `all`, the world model's accuracy, and `inferred`, shares of actions, by form."""
    assert test.actions is not None
    right = {form: (_inferred(inverse, test) == test.actions[:, 0]).double() for form, inverse in inverses.items()}
    return {
        "all": {"world_model": accuracy(*changes(predicted(world_model, test), test.observations), _groups(test))},
        "inferred": {
            form: {group: float(each[members].mean()) for group, members in _groups(test).items() if members.any()}
            for form, each in right.items()
        },
    }


def with_simulator(
    world_model: WorldModel,
    inverses: Mapping[str, ActionInference],
    room: Room,
    test: SegmentBatch,
    states: Sequence[State],
) -> Json:
    """The same, and by form the accuracy of what the simulator does; `masked`: all of it without the noisy tiles."""
    guesses = dict[str, Observations]()
    for form, inverse in inverses.items():
        inferred = _inferred(inverse, test)
        guesses[form] = executed(room.simulator(), states, inferred)
        if room.noisy_tiles:
            guesses[form + FRESH] = executed(room.simulator(), _chance_exchanged(states), inferred)
    guesses["world_model"] = predicted(world_model, test)
    still = without_tiles(torch.from_numpy(np.stack([state["cells"] for state in states])))
    return without_simulator(world_model, inverses, test) | {
        "all": {name: accuracy(*changes(guess, test.observations), _groups(test)) for name, guess in guesses.items()},
        "masked": {
            name: accuracy(*changes(guess, test.observations, still), _groups(test)) for name, guess in guesses.items()
        },
    }


@torch.inference_mode()
def predicted(world_model: WorldModel, test: SegmentBatch) -> Observations:
    """The likeliest next observations (B, ...) under the true actions."""
    parts = []
    for start in range(0, test.size, CHUNK):
        part = test.take(slice(start, start + CHUNK))
        assert part.actions is not None
        state = world_model.infer_state(first(part.observations))
        parts.append(world_model.observe(world_model.predict(state, part.actions[:, 0])))
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def executed(simulator: Simulator, states: Sequence[State], actions: Tensor) -> Observations:
    """What the simulator shows after each action (B,) in each state: (B, ...)."""
    reached = []
    for state, action in zip(states, actions.tolist(), strict=True):
        simulator.restore(state)
        reached.append(simulator.step(action).observation)
    return {name: torch.from_numpy(np.stack([each[name] for each in reached])) for name in reached[0]}


def _chance_exchanged(states: Sequence[State]) -> list[State]:
    """Each state with the generator of the next one."""
    others = [*states[1:], states[0]]
    return [{**state, "generator": other["generator"]} for state, other in zip(states, others, strict=True)]


@torch.inference_mode()
def _inferred(inverse_dynamics: ActionInference, test: SegmentBatch) -> Tensor:
    return inverse_dynamics.infer(test.observations)[:, 0]


def _groups(test: SegmentBatch) -> dict[str, Tensor]:
    assert test.actions is not None
    interacts = torch.isin(test.actions[:, 0], torch.tensor(INTERACTION))
    return {"overall": torch.ones_like(interacts), "movement": ~interacts, "interaction": interacts}
