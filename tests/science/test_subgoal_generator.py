"""The subgoal generator never sees an action, and samples what can follow."""

import numpy as np
import pytest
import torch

from models.families import GRID
from models.segments import Observations, SegmentBatch
from models.training import TrainingConfig, advance, begin
from tests.science import toy_grid


def _one_room(actions: list[int], copies: int) -> tuple[Observations, SegmentBatch]:
    """One state, and what followed it under each of the actions."""
    rng = np.random.default_rng(0)
    grid, carried = toy_grid.rooms(1, rng)
    state = {"grid": torch.from_numpy(grid), "carried": torch.from_numpy(carried)}
    many = grid.repeat(len(actions) * copies, 0), carried.repeat(len(actions) * copies, 0)
    after = toy_grid.step(*many, np.array(actions * copies))
    return state, SegmentBatch(toy_grid.pairs(*many, after))


def test_a_batch_with_actions_is_refused(training_set: SegmentBatch) -> None:
    model = GRID.build_subgoal_generator(toy_grid.SPACES, None, torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="never sees actions"):
        model.loss(training_set, torch.Generator())
    only_sets = SegmentBatch(training_set.observations, action_sets=training_set.action_sets)
    with pytest.raises(ValueError, match="never sees actions"):
        begin_and_train(only_sets)


def begin_and_train(dataset: SegmentBatch) -> None:
    model = GRID.build_subgoal_generator(toy_grid.SPACES, None, torch.Generator().manual_seed(0))
    advance(model, dataset, begin(model, TrainingConfig(1, 1, 1.0, 0.0), torch.Generator()), 1)


def test_samples_follow_the_distribution_of_what_came_next() -> None:
    state, dataset = _one_room([0, 0, 0, 1], copies=64)  # three in four turn left, one in four turns right
    model = GRID.build_subgoal_generator(toy_grid.SPACES, None, torch.Generator().manual_seed(0))
    config = TrainingConfig(100, 64, 1e-2, 1e-4)
    advance(model, dataset, begin(model, config, torch.Generator().manual_seed(1)), config.steps)
    many = {name: stream.expand(400, *stream.shape[1:]) for name, stream in state.items()}
    chain = model.sample(many, 1, torch.Generator().manual_seed(2))
    assert torch.equal(chain["grid"][:, 0], many["grid"])
    left, right = (dataset.observations["grid"][row, 1] for row in (0, 3))
    lefts = float((chain["grid"][:, 1] == left).flatten(1).all(1).float().mean())
    rights = float((chain["grid"][:, 1] == right).flatten(1).all(1).float().mean())
    assert abs(lefts - 0.75) < 0.08
    assert abs(rights - 0.25) < 0.08


def test_a_chain_has_the_horizon_and_repeats_with_its_generator(training_set: SegmentBatch) -> None:
    model = GRID.build_subgoal_generator(toy_grid.SPACES, None, torch.Generator().manual_seed(0))
    states = {name: stream[:9, 0] for name, stream in training_set.observations.items()}
    left, right = (model.sample(states, 3, torch.Generator().manual_seed(4)) for _ in range(2))
    assert left["grid"].shape == (9, 4, 5, 5, 3)
    assert left["carried"].shape == (9, 4, 3)
    assert left["grid"].dtype == torch.uint8
    assert all(torch.equal(left[name], right[name]) for name in left)
