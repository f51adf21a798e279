"""Action-following score: world models whose score is known, and the outcomes that it is held against."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks.paper.minigrid.action_following import (
    Outcomes,
    action_following,
    load_outcomes,
    outcomes,
    spread,
)
from benchmarks.paper.minigrid.datasets import TUNING, DataSpec, load
from models.segments import Observations
from workers.simulators.base import State
from workers.simulators.catalog import make_simulator
from workers.simulators.minigrid import BOX, EMPTY, KEY, PICKUP, RED, SWAP, TOGGLE

A, B, C = (KEY, 0, 0), (KEY, 2, 0), (BOX, 2, 3)
STAND = (EMPTY, 0, 0)


class Table:
    """A world model that says of each action what it is told to, whatever the state."""

    def __init__(self, told: dict[int, tuple[int, int, int]]) -> None:
        self.told = told

    def infer_state(self, observations: Observations) -> Tensor:
        """One row a state."""
        return torch.zeros(len(observations["carried"]), 1)

    def predict(self, state: Tensor, actions: Tensor) -> Tensor:
        """The action is the next state."""
        return actions

    def observe(self, state: Tensor) -> Observations:
        """The hand that is told; the grid is empty."""
        hands = torch.tensor([self.told[action] for action in state.tolist()], dtype=torch.uint8)
        return {"grid": _empty(len(hands)), "carried": hands}


def score(**told: tuple[int, int, int]) -> float:
    """Of a model that tells these hands, where pickup, toggle and swap truly lead to A, B and C."""
    world_model: Any = Table({PICKUP: told["pickup"], TOGGLE: told["toggle"], SWAP: told["swap"]})
    hands = torch.tensor([[A, B, C]], dtype=torch.uint8)  # (1, 3, 3)
    now = {"grid": _empty(1), "carried": torch.tensor([STAND], dtype=torch.uint8)}
    return action_following(world_model, Outcomes(now, {"grid": _empty(3)[None], "carried": hands}))


def test_a_model_that_is_right_has_one_and_one_that_ignores_the_action_none() -> None:
    assert score(pickup=A, toggle=B, swap=C) == 1.0
    assert score(pickup=A, toggle=A, swap=A) == 0.0
    assert score(pickup=STAND, toggle=STAND, swap=STAND) == 0.0


def test_differences_count_by_channel_where_both_predictions_are_right() -> None:
    """A-B differ in colour, A-C in object, colour and state, B-C in object and state: six in all."""
    assert score(pickup=A, toggle=B, swap=B) == pytest.approx(2 / 6)  # the colour of A-B and of A-C
    assert score(pickup=A, toggle=A, swap=C) == pytest.approx(5 / 6)  # all but the colour of A-B


def test_being_different_without_being_right_is_not_following() -> None:
    assert score(pickup=C, toggle=A, swap=B) == pytest.approx(0.0)


def test_actions_without_a_difference_have_no_score() -> None:
    world_model: Any = Table({PICKUP: STAND, TOGGLE: STAND, SWAP: STAND})
    now = {"grid": _empty(1), "carried": torch.tensor([STAND], dtype=torch.uint8)}
    after = {"grid": _empty(3)[None], "carried": torch.tensor([[STAND] * 3], dtype=torch.uint8)}
    with pytest.raises(ValueError, match="lead to the same in all 1 states"):
        action_following(world_model, Outcomes(now, after))


def test_outcomes_are_what_the_simulator_does_from_the_same_state() -> None:
    simulator = make_simulator("minigrid", {})
    simulator.reset(0)
    state = simulator.state()
    state["agent"] = state["agent"] * 0 + (2, 2, 0)  # facing right
    state["cells"][1:-1, 1:-1] = STAND
    state["cells"][4, 4] = (8, 1, 0)
    state["cells"][2, 3] = (KEY, RED, 0)
    found = outcomes(simulator, [state, state])
    assert found.now["grid"].shape == (2, 6, 6, 3)
    assert found.after["carried"][1].tolist() == [[KEY, RED, 0], list(STAND), list(STAND)]  # swap needs a full hand
    assert found.after["grid"][0, :, 2, 3].tolist() == [list(STAND), [KEY, 2, 0], [KEY, RED, 0]]


def test_outcomes_of_a_set_begin_where_its_transitions_do(tmp_path: Path) -> None:
    spec = DataSpec("balanced", 5000, TUNING + 900_000, per_action=3)
    found = load_outcomes(spec, tmp_path, 7)
    assert found.after["grid"].shape == (7, 3, 6, 6, 3)
    grids = {grid.numpy().tobytes() for grid in load(spec, tmp_path).observations["grid"][:, 0]}
    assert {grid.numpy().tobytes() for grid in found.now["grid"]} <= grids


def test_states_are_spread_evenly() -> None:
    states: list[State] = [{} for _ in range(10)]
    places = [[id(one) for one in states].index(id(each)) for each in spread(states, 4)]
    assert places == [0, 3, 6, 9]
    assert len(spread(states, 20)) == 10


def _empty(count: int) -> Tensor:
    grid = torch.zeros(count, 3, 3, 3, dtype=torch.uint8)
    grid[..., 0] = EMPTY
    return grid
