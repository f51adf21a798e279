"""A turned room is a room: the same actions do the same things there."""

import numpy as np
import torch

from models.networks.symmetry import turn, turned
from tests.science import toy_grid


def test_acting_and_turning_change_places() -> None:
    """step(turn(x), a) = turn(step(x, a)) for every action and every number of quarters."""
    rng = np.random.default_rng(0)
    grid, carried = toy_grid.rooms(500, rng)
    for action in range(toy_grid.ACTIONS):
        actions = np.full(len(grid), action)
        after, hand = toy_grid.step(grid, carried, actions)
        for quarters in range(4):
            before_turned, after_turned = (_turned(each, quarters) for each in (grid, after))
            acted, acted_hand = toy_grid.step(before_turned, carried, actions)
            np.testing.assert_array_equal(acted, after_turned)
            np.testing.assert_array_equal(acted_hand, hand)


def test_four_quarters_are_none() -> None:
    batch = toy_grid.labeled(50, seed=1)
    grid = batch.observations["grid"]
    again = grid
    for _ in range(4):
        again = turn(again, torch.ones(50, dtype=torch.int64))
    assert torch.equal(again, grid)
    assert not torch.equal(turn(grid, torch.ones(50, dtype=torch.int64)), grid)


def test_segments_are_turned_as_wholes_and_all_ways() -> None:
    batch = toy_grid.labeled(400, seed=2)
    found = turned(batch, torch.Generator().manual_seed(0))
    assert batch.actions is not None
    assert found.actions is not None
    assert torch.equal(found.actions, batch.actions)
    assert torch.equal(found.observations["carried"], batch.observations["carried"])
    ways = [turn(batch.observations["grid"], torch.full((400,), quarters)) for quarters in range(4)]
    same = torch.stack([(way == found.observations["grid"]).flatten(1).all(1) for way in ways])
    assert bool(same.any(0).all())
    assert bool((same.sum(1) > 60).all())


def test_an_action_of_a_set_is_drawn_evenly_and_always_from_it() -> None:
    batch = toy_grid.labeled(3000, seed=3)
    assert batch.action_sets is not None
    drawn = batch.with_drawn_actions(torch.Generator().manual_seed(0))
    assert drawn.actions is not None
    assert bool(batch.action_sets.gather(2, drawn.actions.unsqueeze(2)).all())
    pairs = (batch.action_sets[:, 0].sum(1) == 4).nonzero().flatten()
    first = batch.action_sets[pairs, 0].byte().argmax(1)
    assert abs(float((drawn.actions[pairs, 0] == first).double().mean()) - 0.25) < 0.05
    unlabeled = batch.without_labels()
    assert unlabeled.with_drawn_actions(torch.Generator()) is unlabeled


def _turned(grid: toy_grid.Codes, quarters: int) -> toy_grid.Codes:
    turned_grid: toy_grid.Codes = turn(torch.from_numpy(grid).unsqueeze(1), torch.full((len(grid),), quarters))[
        :, 0
    ].numpy()
    return turned_grid
