"""Model error on a case computed by hand."""

import pytest
import torch
from torch import Tensor

from models.evaluation import ModelError, evaluate
from models.inverse_dynamics.grid import GridSparseInverseDynamics
from models.segments import Observations, SegmentBatch
from models.world_models.grid import GridWorldModel
from tests.science import toy_grid


class Standstill(GridWorldModel):
    """Predicts the present for ever, at a distance of the action's number."""

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        return torch.cat((state.unsqueeze(1), actions[:, :, None, None, None].expand(-1, -1, 5, 5, 3)), 2)

    def infer_state(
        self, observations: Observations, actions: Tensor | None = None, context: Tensor | None = None
    ) -> Tensor:
        return observations["grid"][:, -1].long()

    def distance(self, prediction: Tensor, reference: Observations) -> Tensor:
        return prediction[:, 0, -1, 0, 0].double()

    def decode(self, state: Tensor) -> Observations:
        frame = state[:, :5].reshape(-1, 3)
        rows = frame.t() + torch.tensor([[0], [11], [17]])
        grid = torch.zeros(22, len(frame)).scatter_(0, rows, 1.0)
        hand = torch.zeros(22, len(state))
        hand[[1, 11, 17]] = 1.0  # an empty hand
        return {"grid": grid, "carried": hand}


class AlwaysLeft(GridSparseInverseDynamics):
    """Infers action 0 everywhere."""

    def infer(self, observations: Observations) -> Tensor:
        return torch.zeros(observations["grid"].shape[0], 1, dtype=torch.int64)


def _error() -> ModelError:
    grid, carried = toy_grid.rooms(3, __import__("numpy").random.default_rng(0))
    carried[:] = (1, 0, 0)
    frames = toy_grid.pairs(grid, carried, (grid, carried))
    frames["grid"][0, 1, 0, 0] = torch.tensor((5, 2, 0))  # one cell changed
    frames["grid"][1, 1, 0, :3] = torch.tensor((5, 2, 0))  # three cells changed
    frames["carried"][1, 0] = torch.tensor((5, 2, 0))  # and the hand emptied
    sets = torch.zeros(3, 1, 7, dtype=torch.bool)
    sets[0, 0, 0] = sets[1, 0, 4] = sets[2, 0, 0] = sets[2, 0, 6] = True
    batch = SegmentBatch(frames, torch.tensor([[0], [4], [6]]), sets)
    generator = torch.Generator().manual_seed(0)
    from models.inverse_dynamics.grid import SparseInverseDynamicsConfig
    from models.world_models.grid import GridWorldModelConfig

    world_model = Standstill(toy_grid.SPACES, GridWorldModelConfig(), generator)
    inverse_dynamics = AlwaysLeft(toy_grid.SPACES, SparseInverseDynamicsConfig(), generator)
    return evaluate(world_model, batch, {**toy_grid.GROUPS, "nothing": {1}}, inverse_dynamics, chunk=2)


def test_errors_by_group_equal_those_computed_by_hand() -> None:
    error = _error()
    assert error.overall.transitions == 3
    assert error.overall.next_state_loss == pytest.approx((0 + 4 + 6) / 3)
    assert error.overall.dynamics_accuracy == 1 / 5  # of 4 changed cells and 1 changed hand only the hand was right
    assert error.overall.inverse_accuracy == pytest.approx(2 / 3)  # the third step's set holds action 0
    assert error.groups["movement"].dynamics_accuracy == 0
    assert error.groups["interaction"].dynamics_accuracy == 1 / 4
    assert error.groups["interaction"].next_state_loss == 5
    assert error.groups["interaction"].inverse_accuracy == 0.5


def test_a_group_without_transitions_has_no_error() -> None:
    nothing = _error().groups["nothing"]
    assert (nothing.transitions, nothing.next_state_loss, nothing.dynamics_accuracy) == (0, None, None)


def test_evaluation_needs_actions(world_model: GridWorldModel, held_out: SegmentBatch) -> None:
    with pytest.raises(ValueError, match="no actions"):
        evaluate(world_model, held_out.without_labels(), toy_grid.GROUPS)


def test_each_chunk_is_told(world_model: GridWorldModel, held_out: SegmentBatch) -> None:
    told: list[None] = []
    evaluate(world_model, held_out, toy_grid.GROUPS, chunk=50, after_each=lambda: told.append(None))
    assert len(told) == -(-held_out.transitions().size // 50)
