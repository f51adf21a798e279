"""Networks trained once for all tests of the folder, on one thread."""

from collections.abc import Iterator

import pytest
import torch

from models.families import GRID
from models.inverse_dynamics.base import DiscreteInverseDynamics
from models.segments import SegmentBatch
from models.training import TrainingConfig, train
from models.world_models.grid import GridWorldModel
from tests.science import toy_grid


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def training_set() -> SegmentBatch:
    """1,500 labeled toy transitions under uniform actions."""
    return toy_grid.labeled(1500, seed=0)


@pytest.fixture(scope="session")
def held_out() -> SegmentBatch:
    """400 effective transitions of other rooms."""
    return toy_grid.labeled(400, seed=1, effective=True)


@pytest.fixture(scope="session")
def movement_only(training_set: SegmentBatch) -> SegmentBatch:
    """500 training transitions whose action is a movement."""
    assert training_set.actions is not None
    return training_set.take(torch.nonzero(training_set.actions[:, 0] < 3).flatten()[:500])


@pytest.fixture(scope="session")
def world_model(movement_only: SegmentBatch) -> GridWorldModel:
    """Knows movement and has never seen an interaction."""
    generator = torch.Generator().manual_seed(0)
    model = GRID.build_world_model(toy_grid.SPACES, None, generator)
    train(model, movement_only, TrainingConfig(400, 32, 1e-2, 1e-2), generator)
    return model


@pytest.fixture(scope="session")
def inverse_dynamics() -> DiscreteInverseDynamics:
    """Sparse, with labels enough to know all seven actions."""
    generator = torch.Generator().manual_seed(1)
    model = GRID.build_inverse_dynamics(toy_grid.SPACES, "sparse", None, generator)
    train(model, toy_grid.labeled(2000, seed=2, effective=True), TrainingConfig(500, 64, 5e-3, 1e-4), generator)
    return model
