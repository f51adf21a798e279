"""Diffusion policies, on a task whose actions are known: go to the goal, and pull when it is near."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from models import checkpoints
from models.policies.camera_encoder import SHIFT, shifted
from models.policies.diffusion import DiffusionPolicy, DiffusionPolicyConfig, training_config
from models.segments import Observations, SegmentBatch
from models.spaces import BoxAction, DiscreteAction, Spaces, StreamSpec
from models.training import TrainingConfig, advance, begin, train

SIZE = 16
CONFIG = DiffusionPolicyConfig(chunk=4, executed=2, channels=16, features=32, image_channels=8)
PLACES = Spaces({"place": StreamSpec((3,), "float32")}, BoxAction(-1.0, 1.0, (2,)))
VIEWS = Spaces({"view": StreamSpec((SIZE, SIZE, 3), "uint8"), **PLACES.observations}, PLACES.action)
SCHEDULE = TrainingConfig(steps=400, batch_size=64, learning_rate=3e-3, weight_decay=1e-4)


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def expert(place: Tensor) -> Tensor:
    """What is right at places (B, 3): the same move four times, (B, 4, 2)."""
    move = torch.stack((place[:, 0].sign() * 0.8, (place[:, 1] / 100.0).clamp(-1.0, 1.0)), 1)
    return move[:, None].expand(-1, 4, -1).clone()


def demonstrations(count: int, seed: int, spaces: Spaces = PLACES) -> SegmentBatch:
    """Places up to 100 m around the origin, the third number always 7; a view is bright where the first is positive."""
    place = (torch.rand(count, 3, generator=seeded(seed)) - 0.5) * 200.0
    place[:, 2] = 7.0
    seen: Observations = {"place": place[:, None].expand(-1, 2, -1).clone()}
    if "view" in spaces.observations:
        bright = (place[:, 0] > 0).byte()[:, None, None, None, None] * 255
        seen = {"view": bright.expand(-1, 2, SIZE, SIZE, 3).clone(), "place": seen["place"] * torch.tensor([0.0, 1, 1])}
    return SegmentBatch(seen, expert(place)[:, None])


@pytest.fixture(scope="module")
def policy() -> DiffusionPolicy:
    return trained(PLACES)


def trained(spaces: Spaces, schedule: TrainingConfig = SCHEDULE) -> DiffusionPolicy:
    generator, batch = seeded(0), demonstrations(500, 1, spaces)
    made = DiffusionPolicy(spaces, CONFIG, generator)
    made.fit_statistics(batch)
    train(made, batch, schedule, generator)
    return made


def error(policy: DiffusionPolicy, batch: SegmentBatch) -> float:
    """Mean distance of sampled from right actions."""
    assert batch.actions is not None
    return float((policy.sample(batch.observations, seeded(3)) - batch.actions[:, 0]).abs().mean())


def test_it_learns_what_is_demonstrated(policy: DiffusionPolicy) -> None:
    other = demonstrations(100, 2)
    assert error(DiffusionPolicy(PLACES, CONFIG, seeded(0)), other) > 0.4
    assert error(policy, other) < 0.15


def test_it_learns_what_only_images_show() -> None:
    other = demonstrations(100, 2, VIEWS)
    assert error(DiffusionPolicy(VIEWS, CONFIG, seeded(0)), other) > 0.4
    assert error(trained(VIEWS, replace(SCHEDULE, steps=150)), other) < 0.2


def test_equal_generators_give_equal_chunks_within_the_box(policy: DiffusionPolicy) -> None:
    seen = demonstrations(8, 4).observations
    chunks = policy.sample(seen, seeded(5))
    assert chunks.shape == (8, 4, 2)
    assert float(chunks.abs().max()) <= 1.0
    torch.rand(100)  # nobody draws from the global generator
    assert torch.equal(policy.sample(seen, seeded(5)), chunks)
    assert not torch.equal(policy.sample(seen, seeded(6)), chunks)


def test_a_checkpoint_acts_as_the_policy_did(policy: DiffusionPolicy) -> None:
    data = checkpoints.save(policy)
    told = checkpoints.describe(data)
    assert (told["family"], told["kind"], told["config"]["chunk"]) == ("diffusion", "policy", 4)
    loaded = checkpoints.load(data, expect_kind="policy")
    assert isinstance(loaded, DiffusionPolicy)
    seen = demonstrations(8, 4).observations
    assert torch.equal(loaded.sample(seen, seeded(5)), policy.sample(seen, seeded(5)))
    assert checkpoints.save(loaded) == data
    with pytest.raises(checkpoints.CheckpointError, match="kind 'world_model', found kind 'policy'"):
        checkpoints.load(data, expect_kind="world_model")


def test_trained_in_pieces_it_has_the_same_weights(policy: DiffusionPolicy) -> None:
    generator, batch = seeded(0), demonstrations(500, 1)
    other = DiffusionPolicy(PLACES, CONFIG, generator)
    other.fit_statistics(batch)
    state = begin(other, SCHEDULE, generator)
    for step in (7, 130, SCHEDULE.steps):
        state = advance(DiffusionPolicy(PLACES, CONFIG, seeded(9)), batch, state, step)
    other.load_state_dict({name[6:]: value for name, value in state.tensors.items() if name.startswith("model.")})
    assert checkpoints.save(other) == checkpoints.save(policy)


def test_numbers_are_normalised_by_the_demonstrations_and_bounded(policy: DiffusionPolicy) -> None:
    batch = demonstrations(500, 1)
    place = batch.observations["place"].flatten(0, 1)
    assert torch.allclose(policy.mean, place.mean(0))
    assert torch.allclose(policy.deviation[:2], place.std(0)[:2])
    assert float(policy.deviation[2]) == pytest.approx(0.01)  # what never changes is not blown up
    far, farther = ({"place": torch.full((1, 2, 3), number)} for number in (1e4, 1e6))
    assert torch.equal(policy.encode(far), policy.encode(farther))


def test_only_the_last_two_observations_and_chunks_that_fit_are_taken() -> None:
    made, batch = DiffusionPolicy(PLACES, CONFIG, seeded(0)), demonstrations(10, 1)
    made.check(batch)
    assert batch.actions is not None
    with pytest.raises(ValueError, match=r"actions must have the shape .* = \(10, 1, 4, 2\), got \(10, 1, 3, 2\)"):
        made.check(replace(batch, actions=batch.actions[:, :, :3]))
    with pytest.raises(ValueError, match="actions must lie between -1 and 1"):
        made.check(replace(batch, actions=batch.actions * 3))
    with pytest.raises(ValueError, match="place must hold finite numbers only"):
        made.check(replace(batch, observations={"place": batch.observations["place"] * np.nan}))
    with pytest.raises(ValueError, match="the batch carries none"):
        made.loss(batch.without_labels(), seeded(0))


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="chunk must be even and at least 2, got 5"):
        DiffusionPolicyConfig(chunk=5)
    with pytest.raises(ValueError, match=r"executed must be from 1 to chunk \(4\), got 5"):
        DiffusionPolicyConfig(chunk=4, executed=5)
    with pytest.raises(ValueError, match="vectors of a box"):
        DiffusionPolicy(Spaces(PLACES.observations, DiscreteAction(3)), CONFIG, seeded(0))
    with pytest.raises(ValueError, match="multiples of 16, got 20 x 16"):
        DiffusionPolicy(Spaces({"view": StreamSpec((20, 16, 3), "uint8")}, PLACES.action), CONFIG, seeded(0))


def test_every_form_has_a_schedule() -> None:
    assert training_config(PLACES).steps > training_config(VIEWS).steps > 0


def test_images_are_shifted_by_rows_and_the_same_over_time() -> None:
    images = torch.arange(SIZE * SIZE).view(1, 1, SIZE, SIZE, 1).expand(6, 2, -1, -1, 3).clone()
    moved = shifted(images, seeded(0))
    assert moved.shape == images.shape
    assert torch.equal(moved[:, 0], moved[:, 1])
    middle = SIZE // 2
    found = {divmod(int(each[0, middle, middle, 0]), SIZE) for each in moved}
    assert len(found) > 1
    assert all(abs(place - middle) <= SHIFT for pair in found for place in pair)
    assert set(moved.flatten().tolist()) <= set(images.flatten().tolist())
