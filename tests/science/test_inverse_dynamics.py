"""Inverse dynamics recovers actions, and the likelihood of a set is the sum over it."""

import math

import pytest
import torch

from models.evaluation import evaluate
from models.families import GRID
from models.inverse_dynamics.base import DiscreteInverseDynamics, negative_log_likelihood
from models.networks.grid import touched_cells
from models.segments import SegmentBatch
from models.training import TrainingConfig, train
from models.world_models.grid import GridWorldModel
from tests.science import toy_grid


def test_sparse_inverse_dynamics_learns_the_seven_actions(
    inverse_dynamics: DiscreteInverseDynamics, world_model: GridWorldModel, held_out: SegmentBatch
) -> None:
    one_by_one = {str(action): {action} for action in range(toy_grid.ACTIONS)}
    error = evaluate(world_model, held_out, one_by_one, inverse_dynamics)
    accuracies = [group.inverse_accuracy for group in error.groups.values()]
    assert min(accuracy for accuracy in accuracies if accuracy is not None) >= 0.8, accuracies
    assert error.overall.inverse_accuracy is not None
    assert error.overall.inverse_accuracy >= 0.97


def test_sparse_inverse_dynamics_sees_nothing_but_what_the_action_touches(
    inverse_dynamics: DiscreteInverseDynamics, held_out: SegmentBatch
) -> None:
    grid = held_out.observations["grid"].clone()
    cells = grid.flatten(2, 3)  # (B, 2, S*S, 3), shares memory with grid
    elsewhere = torch.ones(len(cells), cells.shape[2], dtype=torch.bool)
    elsewhere.scatter_(1, touched_cells(grid[:, 0]), False)
    cells[elsewhere.unsqueeze(1).expand(-1, 2, -1)] = torch.tensor((5, 2, 0), dtype=torch.uint8)
    changed = SegmentBatch({**held_out.observations, "grid": cells.view_as(grid)})
    assert torch.equal(inverse_dynamics.log_prob(changed), inverse_dynamics.log_prob(held_out))


def test_dense_inverse_dynamics_fits_what_it_was_shown(training_set: SegmentBatch) -> None:
    generator = torch.Generator().manual_seed(0)
    model = GRID.build_inverse_dynamics(toy_grid.SPACES, "dense", None, generator)
    shown = training_set.take(slice(0, 100))
    train(model, shown, TrainingConfig(150, 64, 3e-3, 1e-3), generator)
    likely = model.infer(shown.observations).unsqueeze(2)
    assert shown.action_sets is not None
    assert float(shown.action_sets.gather(2, likely).float().mean()) >= 0.95


def test_the_likelihood_of_a_set_is_the_summed_probability() -> None:
    log_prob = torch.tensor([[[0.5, 0.25, 0.25]], [[0.5, 0.25, 0.25]]]).log()
    batch = SegmentBatch(
        {"x": torch.zeros(2, 2)},
        actions=torch.tensor([[0], [2]]),
        action_sets=torch.tensor([[[True, True, False]], [[False, False, True]]]),
    )
    expected = [[-math.log(0.75)], [-math.log(0.25)]]
    torch.testing.assert_close(negative_log_likelihood(log_prob, batch), torch.tensor(expected))


def test_without_sets_the_likelihood_is_the_actions() -> None:
    log_prob = torch.tensor([[[0.5, 0.25, 0.25]]]).log()
    batch = SegmentBatch({"x": torch.zeros(1, 2)}, actions=torch.tensor([[1]]))
    torch.testing.assert_close(negative_log_likelihood(log_prob, batch), torch.tensor([[math.log(4)]]))


def test_an_empty_action_set_is_refused() -> None:
    batch = SegmentBatch({"x": torch.zeros(1, 2)}, action_sets=torch.zeros(1, 1, 3, dtype=torch.bool))
    with pytest.raises(ValueError, match="empty set"):
        negative_log_likelihood(torch.zeros(1, 1, 3), batch)


def test_touched_cells_are_the_agents_and_the_one_it_faces() -> None:
    grid = torch.ones(4, 5, 5, 3, dtype=torch.uint8)
    for direction in range(4):
        grid[direction, 2, 3] = torch.tensor((toy_grid.AGENT, 0, direction))
    # row 2, column 3 is cell 13; right, down, left, up
    assert touched_cells(grid).tolist() == [[13, 14], [13, 18], [13, 12], [13, 8]]
