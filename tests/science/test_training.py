"""Training is deterministic, resumable bit for bit, and names what broke it."""

from dataclasses import replace

import pytest
import torch

from models.families import GRID
from models.segments import SegmentBatch
from models.training import (
    NonFiniteError,
    TrainingConfig,
    TrainingState,
    advance,
    begin,
    learning_rate,
    train,
)
from tests.science import toy_grid

CONFIG = TrainingConfig(steps=12, batch_size=16, learning_rate=1e-2, weight_decay=1e-4)


def _weights(seed: int, training_set: SegmentBatch) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    model = GRID.build_world_model(toy_grid.SPACES, None, generator)
    train(model, training_set.take(slice(0, 50)), CONFIG, generator)
    return dict(model.state_dict())


def test_the_generator_alone_decides_the_weights(training_set: SegmentBatch) -> None:
    left, right, other = (_weights(seed, training_set) for seed in (0, 0, 1))
    assert all(torch.equal(left[name], right[name]) for name in left)
    assert any(not torch.equal(left[name], other[name]) for name in left)


@pytest.mark.parametrize("slices", [(5, 7), (1, 3, 20)])
def test_interrupted_training_equals_uninterrupted_training(
    slices: tuple[int, ...], training_set: SegmentBatch
) -> None:
    dataset = training_set.take(slice(0, 50)).without_labels()
    whole = GRID.build_subgoal_generator(toy_grid.SPACES, None, torch.Generator().manual_seed(0))
    start = begin(whole, CONFIG, torch.Generator().manual_seed(7))
    end = advance(whole, dataset, start, CONFIG.steps)
    data = start.to_bytes()
    for steps in slices:  # each slice in a network of its own, as another process would
        fresh = GRID.build_subgoal_generator(toy_grid.SPACES, None, torch.Generator().manual_seed(99))
        state = TrainingState.from_bytes(data)
        data = advance(fresh, dataset, state, min(state.step + steps, CONFIG.steps)).to_bytes()
    resumed = TrainingState.from_bytes(data)
    assert resumed.step == end.step == CONFIG.steps
    assert resumed.recent == end.recent
    assert resumed.tensors.keys() == end.tensors.keys()
    assert all(torch.equal(resumed.tensors[name], end.tensors[name]) for name in end.tensors)
    assert all(torch.equal(fresh.state_dict()[name], whole.state_dict()[name]) for name in whole.state_dict())


def test_a_non_finite_loss_names_step_and_segments(training_set: SegmentBatch) -> None:
    model = GRID.build_world_model(toy_grid.SPACES, None, torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.attention.bias[0] = torch.nan
    with pytest.raises(NonFiniteError, match=r"loss of world_model is nan at step 0; its segments: toy-0:\d"):
        train(model, training_set.take(torch.arange(3)), CONFIG, torch.Generator())


def test_training_on_nothing_is_refused(training_set: SegmentBatch) -> None:
    model = GRID.build_world_model(toy_grid.SPACES, None, torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="at least one segment"):
        train(model, training_set.take(slice(0, 0)), CONFIG, torch.Generator())


def test_progress_ends_with_the_last_step(training_set: SegmentBatch) -> None:
    model = GRID.build_inverse_dynamics(toy_grid.SPACES, "sparse", None, torch.Generator().manual_seed(0))
    seen: list[tuple[int, int]] = []
    config = replace(CONFIG, steps=60)
    result = train(model, training_set, config, torch.Generator(), progress=lambda step, of, _: seen.append((step, of)))
    assert seen == [(25, 60), (50, 60), (60, 60)]
    assert result.steps == 60


def test_the_learning_rate_rises_then_falls_to_nothing() -> None:
    rates = [learning_rate(TrainingConfig(100, 1, 1.0, 0.0), step) for step in range(100)]
    assert max(rates) == rates[15] == 1.0
    assert rates[:15] == sorted(rates[:15])
    assert rates[15:] == sorted(rates[15:], reverse=True)
    assert rates[-1] < 0.001


def test_a_constant_learning_rate_stays_after_the_warm_up() -> None:
    config = TrainingConfig(100, 1, 1.0, 0.0, warm_up=0.1, constant=True)
    rates = [learning_rate(config, step) for step in range(100)]
    assert rates[:11] == sorted(rates[:11])
    assert set(rates[10:]) == {1.0}


def test_foreign_bytes_are_no_training_state() -> None:
    with pytest.raises(ValueError, match="no training state"):
        TrainingState.from_bytes(b"not safetensors at all")
