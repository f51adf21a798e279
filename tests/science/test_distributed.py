"""Two processes train as one does."""

from dataclasses import replace

import pytest
import torch

from models.segments import SegmentBatch
from models.training import TrainingConfig, advance, begin
from models.world_models.recurrent import RecurrentWorldModel
from tests.science import toy_robot
from workers.training_processes import TrainingProcesses

CONFIG = TrainingConfig(steps=60, batch_size=16, learning_rate=1e-2, weight_decay=0.0, clip=100.0)


class Slope(torch.nn.Module):
    """Predicts the next position linearly; its loss draws nothing."""

    family, kind, spaces, config = "toy", "world_model", toy_robot.POINT, None

    def __init__(self) -> None:
        super().__init__()
        self.linear = torch.nn.Linear(4, 2)
        with torch.no_grad():
            self.linear.weight.zero_()
            self.linear.bias.zero_()

    def check(self, batch: SegmentBatch) -> None:
        """Anything will do."""

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> torch.Tensor:
        """Mean squared error of the last position."""
        assert batch.actions is not None
        position = batch.observations["position"]
        guess = self.linear(torch.cat((position[:, 0], batch.actions[:, 0]), 1))
        return torch.nn.functional.mse_loss(guess, position[:, 1])


def test_without_chance_two_processes_do_what_one_does() -> None:
    dataset, network = toy_robot.points(16, 1, seed=0), Slope()  # one minibatch, in whatever order
    start = begin(network, CONFIG, torch.Generator().manual_seed(3))
    with TrainingProcesses(network, dataset, start, ("cpu", "cpu")) as processes:
        halfway, _ = processes.advance(20)
        shared, shared_loss = processes.advance(40)
        processes._processes[1].kill()
        with pytest.raises(RuntimeError, match="Training process 1 ended with status -9"):
            processes.advance(60)
    alone = advance(network, dataset, start, 40)
    assert (halfway.step, shared.step) == (20, 40)
    for name in ("model.linear.weight", "optimiser.exp_avg.linear.weight"):
        torch.testing.assert_close(shared.tensors[name], alone.tensors[name], rtol=1e-4, atol=1e-6)
    assert 0.0 < shared_loss < 0.4


def test_the_world_model_learns_alike_in_two_processes() -> None:
    dataset = toy_robot.points(200, 11, seed=0)
    network = RecurrentWorldModel(toy_robot.POINT, toy_robot.TINY, torch.Generator().manual_seed(0))
    start = begin(network, CONFIG, torch.Generator().manual_seed(3))
    with TrainingProcesses(network, dataset, start, ("cpu", "cpu")) as processes:
        shared, _ = processes.advance(CONFIG.steps)
    alone = advance(network, dataset, start, CONFIG.steps)
    means = [sum(state.recent) / len(state.recent) for state in (shared, alone)]
    assert len(shared.recent) == len(alone.recent) == 6
    assert means[0] == pytest.approx(means[1], rel=0.3)


def test_a_minibatch_that_cannot_be_shared_is_refused() -> None:
    network = Slope()
    start = begin(network, replace(CONFIG, batch_size=15), torch.Generator())
    with pytest.raises(ValueError, match="minibatch of 15 segments cannot be shared by 2 processes"):
        TrainingProcesses(network, toy_robot.points(30, 1, seed=0), start, ("cpu", "cpu"))
