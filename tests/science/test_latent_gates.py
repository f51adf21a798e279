"""The learned mask over a robot's coordinates: it keeps what the action moves and closes what merely goes along."""

from dataclasses import replace

import pytest
import torch

from models.inverse_dynamics.base import VerifyingBlock
from models.inverse_dynamics.latent_gates import SMALL, LatentGatesConfig, LatentMaskedInverseDynamics
from models.segments import SegmentBatch
from models.training import TrainingConfig, train
from tests.science import toy_point, toy_robot

SCHEDULE = TrainingConfig(steps=800, batch_size=32, learning_rate=1e-2, weight_decay=1e-2)
DISTRACTORS = toy_point.DISTRACTORS  # the first coordinates: streams come by name


def _trained(config: LatentGatesConfig) -> LatentMaskedInverseDynamics:
    model = LatentMaskedInverseDynamics(toy_point.SPACES, config, torch.Generator().manual_seed(0))
    train(model, toy_point.segments(200, 1, seed=1, together=0.5), SCHEDULE, torch.Generator().manual_seed(1))
    return model


@pytest.fixture(scope="module")
def masked() -> LatentMaskedInverseDynamics:
    return _trained(SMALL)


@pytest.fixture(scope="module")
def new_combinations() -> SegmentBatch:
    return toy_point.segments(400, 1, seed=3, together=0.0)


def _error(model: LatentMaskedInverseDynamics, batch: SegmentBatch) -> float:
    assert batch.actions is not None
    with torch.no_grad():
        return float((model.infer(batch.observations) - batch.actions)[..., :2].square().mean())


def test_the_mask_keeps_the_point_and_the_finger_alone(
    masked: LatentMaskedInverseDynamics, new_combinations: SegmentBatch
) -> None:
    opened = (masked.open_gates() > 0).tolist()
    assert opened == [False] * DISTRACTORS + [True] * 3
    assert masked.coordinates == DISTRACTORS + 3
    assert masked.kept(new_combinations.observations).tolist() == [3] * 400


def test_the_masked_form_recovers_actions_in_new_combinations_where_the_same_without_a_price_does_not(
    masked: LatentMaskedInverseDynamics, new_combinations: SegmentBatch
) -> None:
    free = _trained(replace(SMALL, sparsity=0.0))
    assert _error(masked, new_combinations) < 0.02  # of a variance of 1/3
    assert _error(free, new_combinations) > 5 * _error(masked, new_combinations)
    with torch.no_grad():
        signs = masked.infer(new_combinations.observations)[..., 2]
    assert new_combinations.actions is not None
    assert bool((signs.abs() == 1.0).all())
    assert float((signs == new_combinations.actions[..., 2].sign()).float().mean()) > 0.99


def test_closed_coordinates_are_not_read(masked: LatentMaskedInverseDynamics, new_combinations: SegmentBatch) -> None:
    observations = dict(new_combinations.observations)
    moved = {**observations, "objects": observations["objects"] + 5.0 * torch.rand(400, 2, 6)}
    with torch.no_grad():
        assert torch.equal(masked.infer(moved), masked.infer(observations))


def test_what_is_read_and_what_is_left_out_are_all_coordinates(
    masked: LatentMaskedInverseDynamics, new_combinations: SegmentBatch
) -> None:
    assert isinstance(masked, VerifyingBlock)
    assert masked.verifying_block(new_combinations.observations).shape == (400, 2 * 3)
    assert masked.rest(new_combinations.observations).shape == (400, 2 * DISTRACTORS)


def test_images_have_a_latent_that_shows_them_and_tells_the_action() -> None:
    config = replace(SMALL, latent=8, free=1000)  # the gates stay open
    model = LatentMaskedInverseDynamics(toy_robot.PICTURE, config, torch.Generator().manual_seed(0))
    action_free = toy_robot.pictures(500, 1, seed=3).without_labels()
    schedule = replace(SCHEDULE, steps=300, learning_rate=3e-3)
    train(
        model, toy_robot.pictures(300, 1, seed=1), schedule, torch.Generator().manual_seed(1), action_free=action_free
    )
    test = toy_robot.pictures(200, 1, seed=2)
    with torch.no_grad():
        assert float(model.frame.error(model.frame(test.observations), test.observations)) < 0.4  # of a variance of 1
        assert test.actions is not None
        assert float((model.infer(test.observations) - test.actions).square().mean()) < 0.25  # of 1/3
