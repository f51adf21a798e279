"""The bound of the world model's benchmark: all products of a step, and nothing else."""

import pytest
import torch
from torch import nn

from benchmarks.world_model.products import Recorder, bare
from benchmarks.world_model.step import PARTS, SPACES, Step, sequences, shares
from models.training import TrainingConfig
from models.world_models.recurrent import RecurrentWorldModel
from tests.science.toy_robot import TINY


def test_products_of_both_passes_are_noted_and_nothing_else() -> None:
    network = nn.Sequential(nn.Conv2d(3, 4, 3), nn.SiLU(), nn.Flatten(), nn.Linear(16, 2, bias=False))
    with Recorder() as recorder:
        network(torch.zeros(5, 3, 4, 4)).sum().backward()
    noted = {str(product.operation): count for product, count in recorder.products.items()}
    assert sum(recorder.products.values()) == 5  # two of the convolution, three of the layer
    assert noted.keys() == {"aten.convolution.default", "aten.convolution_backward.default", "aten.mm.default"}
    again = Recorder()
    with torch.no_grad(), again:
        bare(recorder.products, torch.device("cpu"))()
    assert again.products == recorder.products


def test_a_step_in_parts_has_the_gradient_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    batch = sequences(generator).take(slice(0, 2))
    model = RecurrentWorldModel(SPACES, TINY, generator)
    step = Step(model, batch.windows(TINY.window - 1, generator), TrainingConfig(1, 2, 0.0, 0.0, clip=1e9), generator)
    model.streams.measure(step.batch.observations)
    monkeypatch.setattr(model.streams, "measure", lambda _: None)
    before = generator.get_state()
    step.backward()
    whole = {name: parameter.grad.clone() for name, parameter in model.named_parameters() if parameter.grad is not None}
    generator.set_state(before)
    spent = shares(step, torch.device("cpu"))
    assert set(spent) == set(PARTS)
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None
        torch.testing.assert_close(parameter.grad, whole[name])
