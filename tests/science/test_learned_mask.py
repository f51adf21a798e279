"""The learned mask: gates that are exactly 0 or 1, a penalty on how many are open, and what a mask comes to keep."""

import pytest
import torch

from models.families import GRID
from models.inverse_dynamics.gates import GridCellMaskedInverseDynamics, MaskedInverseDynamicsConfig
from models.networks.gates import PenaltyRamp, inference_gates, open_probability, sample_gates
from models.networks.grid import touched_cells
from models.segments import SegmentBatch, at
from models.training import TrainingConfig, train
from tests.science import toy_grid


def test_sampled_gates_are_open_as_often_as_their_probability_says() -> None:
    logits = torch.linspace(-4, 4, 9).unsqueeze(1).expand(-1, 20_000)
    sampled = sample_gates(logits, torch.Generator().manual_seed(0))
    assert float(sampled.min()) == 0.0
    assert float(sampled.max()) == 1.0
    torch.testing.assert_close((sampled > 0).float().mean(1), open_probability(logits[:, 0]), atol=0.015, rtol=0)


def test_gates_without_chance_are_closed_or_open_at_the_ends() -> None:
    assert inference_gates(torch.tensor([-9.0, 0.0, 9.0])).tolist() == [0.0, 0.5, 1.0]


def test_the_penalty_has_no_weight_at_first_and_its_full_weight_after_the_ramp() -> None:
    ramp = PenaltyRamp(0.5, free=2, ramp=4)
    assert [float(ramp()) for _ in range(9)] == [0.0, 0.0, 0.0, 0.125, 0.25, 0.375, 0.5, 0.5, 0.5]


def test_resumed_training_goes_on_with_the_ramp_where_it_stopped() -> None:
    first, second = PenaltyRamp(1.0, 0, 10), PenaltyRamp(1.0, 0, 10)
    for _ in range(5):
        first()
    second.load_state_dict(first.state_dict())
    assert float(second()) == float(first()) == 0.5


@pytest.fixture(scope="module")
def masked() -> GridCellMaskedInverseDynamics:
    generator = torch.Generator().manual_seed(3)
    model = GRID.build_inverse_dynamics(toy_grid.SPACES, "masked", None, generator)
    labeled = toy_grid.labeled(2000, seed=2, effective=True)
    train(model, labeled, GRID.training_config(model.kind, labeled.size), generator)
    assert isinstance(model, GridCellMaskedInverseDynamics)
    return model


def test_the_mask_finds_what_actions_touch(masked: GridCellMaskedInverseDynamics, held_out: SegmentBatch) -> None:
    """A move shows in the agent's cell alone, so the cell in front is opened where there is something to act on."""
    now = at(held_out.observations, 0)["grid"]
    opened, touched = masked.open_cells(now), touched_cells(now)
    assert float(opened.float().gather(1, touched).amax(1).mean()) > 0.95
    assert float(opened.scatter(1, touched, False).sum(1).float().mean()) < 0.5  # others, of 23
    assert held_out.actions is not None
    assert float(masked.infer(held_out.observations).eq(held_out.actions).float().mean()) > 0.95


def test_closed_cells_are_not_read(masked: GridCellMaskedInverseDynamics, held_out: SegmentBatch) -> None:
    """The second frame alone is changed: the gates come from the first."""
    grid = held_out.observations["grid"].clone()
    closed = ~masked.open_cells(grid[:, 0])
    grid.flatten(2, 3)[:, 1][closed] = torch.tensor((5, 2, 0), dtype=torch.uint8)
    changed = SegmentBatch({**held_out.observations, "grid": grid})
    torch.testing.assert_close(masked.log_prob(changed), masked.log_prob(held_out))


def test_what_is_read_and_what_is_left_out_are_the_whole_observation(
    masked: GridCellMaskedInverseDynamics, held_out: SegmentBatch
) -> None:
    rest = masked.rest(held_out.observations).view(held_out.size, 2, -1, 22)
    shown = rest.sum((1, 3)) / 6  # channels of both frames, of each cell
    assert torch.equal(shown > 0, ~masked.open_cells(held_out.observations["grid"][:, 0]))
    assert masked.verifying_block(held_out.observations).shape == (held_out.size, 3 * 2 * 22)


@pytest.mark.parametrize("sparsity", [0.0, 0.1])
def test_a_mask_over_latent_coordinates_closes_under_its_penalty(sparsity: float) -> None:
    """Without a price all coordinates stay open; at a tenth of a nat each most are given up."""
    generator = torch.Generator().manual_seed(3)
    config = MaskedInverseDynamicsConfig(over="latent", sparsity=sparsity, free=20, ramp=40, latent=16)
    model = GRID.build_inverse_dynamics(toy_grid.SPACES, "masked", config, generator)
    labeled = toy_grid.labeled(300, seed=2, effective=True)
    train(model, labeled, TrainingConfig(400, 64, 5e-3, 1e-4), generator)
    kept = model.kept(labeled.observations)
    assert int(kept.min()) == int(kept.max())
    assert (int(kept[0]) == 16) if sparsity == 0.0 else (1 <= int(kept[0]) <= 8)
    with torch.inference_mode():
        assert bool(torch.isfinite(model.log_prob(labeled)).all())
