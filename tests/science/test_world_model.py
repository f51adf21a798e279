"""The grid world model: what it learns, and its cross-entropy against the definition."""

import math

import pytest
import torch
from torch.nn import functional as F

from models.evaluation import evaluate
from models.families import GRID
from models.networks.grid import cross_entropy
from models.segments import SegmentBatch, at, first, future
from models.training import TrainingConfig, train
from models.world_models.grid import GridWorldModel, GridWorldModelConfig
from tests.science import toy_grid


def test_the_world_model_fits_a_small_set(training_set: SegmentBatch) -> None:
    generator = torch.Generator().manual_seed(0)
    model = GRID.build_world_model(toy_grid.SPACES, None, generator)
    small = training_set.take(slice(0, 100))
    train(model, small, TrainingConfig(750, 32, 1e-2, 1e-4), generator)
    error = evaluate(model, small, toy_grid.GROUPS)
    assert error.overall.dynamics_accuracy is not None
    assert error.overall.dynamics_accuracy >= 0.98


def test_the_world_model_generalises_the_movement_it_has_seen(
    world_model: GridWorldModel, held_out: SegmentBatch
) -> None:
    movement = evaluate(world_model, held_out, toy_grid.GROUPS).groups["movement"]
    assert movement.dynamics_accuracy is not None
    assert movement.dynamics_accuracy >= 0.75


def test_cross_entropy_is_the_sum_over_the_three_channels() -> None:
    logits = torch.randn(22, 4, generator=torch.Generator().manual_seed(0))
    elements = torch.tensor([[10, 5, 4], [0, 0, 0], [1, 2, 3], [7, 4, 1]], dtype=torch.uint8)
    heads = logits.t().split((11, 6, 5), dim=1)  # type: ignore[no-untyped-call]  # untyped in torch
    expected = sum(F.cross_entropy(h, elements[:, i].long(), reduction="none") for i, h in enumerate(heads))
    torch.testing.assert_close(cross_entropy(logits, elements), expected)


def test_distance_counts_every_cell_and_the_carried_object(world_model: GridWorldModel, held_out: SegmentBatch) -> None:
    observations = held_out.take(slice(0, 3)).observations
    assert held_out.actions is not None
    prediction = world_model.rollout(world_model.infer_state(first(observations)), held_out.actions[:3])
    logits = world_model.decode(prediction[:, 0])
    after = at(observations, 1)
    for row in range(3):
        cells = cross_entropy(logits["grid"][:, row * 25 : (row + 1) * 25], after["grid"][row].view(-1, 3)).sum()
        hand = cross_entropy(logits["carried"][:, row : row + 1], after["carried"][row : row + 1]).sum()
        total = world_model.distance(prediction, future(observations))[row]
        torch.testing.assert_close(total, cells + hand)


def test_no_surprise_is_endless_and_certainty_costs_next_to_nothing(
    world_model: GridWorldModel, held_out: SegmentBatch
) -> None:
    """A decoded channel is uniform by `floor`: a key for a ball costs as much as that is below certain."""
    now = first(held_out.take(slice(0, 4)).observations)
    certain = world_model.encode(at(now, 0)).unsqueeze(1)
    other = {**now, "carried": now["carried"].clone()}
    other["carried"][..., 0] = 3  # what nobody carries
    floor, of = world_model.config.floor, 11
    surprise = world_model.distance(certain, other) - world_model.distance(certain, now)
    expected = math.log((1 - floor + floor / of) / (floor / of))
    torch.testing.assert_close(surprise, torch.full((4,), expected), rtol=1e-3, atol=0)
    assert float(world_model.distance(certain, now).max()) < 2.6 * floor * 26  # cells and the hand


def test_distances_of_several_steps_add_up(world_model: GridWorldModel, held_out: SegmentBatch) -> None:
    some = held_out.take(slice(0, 3))
    assert some.actions is not None
    once = world_model.rollout(world_model.infer_state(first(some.observations)), some.actions)
    after = future(some.observations)
    twice = {name: torch.cat((stream, stream), 1) for name, stream in after.items()}
    both = world_model.distance(torch.cat((once, once), 1), twice)
    torch.testing.assert_close(both, 2 * world_model.distance(once, after))
    with pytest.raises(ValueError, match="other steps"):
        world_model.distance(once, twice)


def test_a_floor_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="floor must be between 0 and 1, got 0"):
        GridWorldModelConfig(floor=0.0)


def test_a_rollout_is_repeated_prediction(world_model: GridWorldModel, held_out: SegmentBatch) -> None:
    state = world_model.encode(at(held_out.observations, 0))
    actions = torch.randint(0, 7, (held_out.size, 2), generator=torch.Generator().manual_seed(0))
    twice = world_model.predict(world_model.predict(state, actions[:, 0]), actions[:, 1])
    assert torch.equal(world_model.rollout(state, actions)[:, 1], twice)


def test_building_draws_from_the_generator_alone() -> None:
    before = torch.get_rng_state()
    left, right = (
        GRID.build_world_model(toy_grid.SPACES, None, torch.Generator().manual_seed(3)).state_dict() for _ in range(2)
    )
    assert all(torch.equal(left[name], right[name]) for name in left)
    assert torch.equal(torch.get_rng_state(), before)


def test_values_outside_the_vocabulary_are_named(world_model: GridWorldModel, held_out: SegmentBatch) -> None:
    grid = held_out.observations["grid"].clone()
    grid[3, 0, 1, 1, 1] = 77
    with pytest.raises(ValueError, match="grid: colour must be below 6, got 77"):
        world_model.check(SegmentBatch({**held_out.observations, "grid": grid}))


def test_a_batch_without_actions_does_not_train(world_model: GridWorldModel, held_out: SegmentBatch) -> None:
    with pytest.raises(ValueError, match="no actions"):
        world_model.loss(held_out.without_labels(), torch.Generator())
