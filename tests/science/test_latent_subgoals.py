"""The robots' subgoal generator: its samples stay where the toys' dynamics can go, and fill it."""

from dataclasses import replace

import pytest
import torch

from models.segments import Observations, at
from models.subgoal_generators.latent import SMALL, LatentSubgoalGenerator
from models.training import TrainingConfig, train
from tests.science import toy_point, toy_robot

SCHEDULE = TrainingConfig(steps=1500, batch_size=64, learning_rate=3e-3, weight_decay=1e-4)
STATES, HORIZON = 500, 4


@pytest.fixture(scope="module")
def generator() -> LatentSubgoalGenerator:
    model = LatentSubgoalGenerator(toy_point.SPACES, SMALL, torch.Generator().manual_seed(0))
    action_free = toy_point.segments(1000, 2, seed=1, together=0.5).without_labels()
    train(model, action_free, SCHEDULE, torch.Generator().manual_seed(1))
    return model


@pytest.fixture(scope="module")
def states() -> Observations:
    return at(toy_point.segments(STATES, 1, seed=2, together=0.5).observations, 0)


def test_every_step_of_a_chain_is_one_that_an_action_could_take(
    generator: LatentSubgoalGenerator, states: Observations
) -> None:
    chain = generator.sample(states, HORIZON, torch.Generator().manual_seed(3))
    way = chain["proprioception"].diff(dim=1)[..., :2] / toy_point.STEP  # an action's reach is -1 to 1
    for step in range(HORIZON):
        assert float((way[:, step].abs() < 1.25).all(1).float().mean()) > 0.9
    assert float((chain["proprioception"][..., 2] - 0.5).abs().max()) < 0.6  # the finger is at 0 or 1


def test_all_that_an_action_could_do_is_among_the_samples(
    generator: LatentSubgoalGenerator, states: Observations
) -> None:
    chain = generator.sample(states, 1, torch.Generator().manual_seed(3))
    way = chain["proprioception"].diff(dim=1)[:, 0, :2] / toy_point.STEP
    for quadrant in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        assert 0.17 < float((way * torch.tensor(quadrant) > 0).all(1).float().mean()) < 0.33
    assert 0.45 < float(way.std()) < 0.7  # 0.577 of a uniform way
    opened = (chain["proprioception"][:, 1, 2] > 0.5).float().mean()
    assert 0.3 < float(opened) < 0.7


def test_what_goes_along_in_the_data_goes_along_in_a_sample(
    generator: LatentSubgoalGenerator, states: Observations
) -> None:
    """A distractor's way is half the point's and half its own: what it has of its own stays within 0.5."""
    chain = generator.sample(states, 1, torch.Generator().manual_seed(3))
    point, objects = (chain[name].diff(dim=1)[:, 0] / toy_point.STEP for name in ("proprioception", "objects"))
    own = objects - 0.5 * point[:, :2].repeat(1, 3)
    assert float((own.abs() < 0.7).float().mean()) > 0.93
    assert 0.2 < float(own.std()) < 0.4  # 0.289 of a uniform way


def test_a_chain_begins_at_its_state_and_repeats_with_its_generator(
    generator: LatentSubgoalGenerator, states: Observations
) -> None:
    left, right, other = (generator.sample(states, 3, torch.Generator().manual_seed(seed)) for seed in (4, 4, 5))
    for name, stream in states.items():
        assert left[name].shape == (STATES, 4, *stream.shape[1:])
        assert torch.equal(left[name][:, 0], stream)
        assert torch.equal(left[name], right[name])
        assert not torch.equal(left[name], other[name])


def test_that_nothing_happens_is_among_the_futures(generator: LatentSubgoalGenerator, states: Observations) -> None:
    some = {name: stream[:5] for name, stream in states.items()}
    futures = generator.futures(some, 2, torch.Generator().manual_seed(3))
    assert futures.states.bincount().tolist() == [SMALL.futures + 1] * 5
    still = torch.stack([(stream == stream[:, :1]).flatten(1).all(1) for stream in futures.chains.values()]).all(0)
    assert still.nonzero().flatten().tolist() == list(range(5 * SMALL.futures, 5 * SMALL.futures + 5))
    assert torch.equal(futures.chains["objects"][:, 0], some["objects"][futures.states])


def test_actions_are_refused_and_a_number_that_is_not_finite_names_its_segment() -> None:
    model = LatentSubgoalGenerator(toy_point.SPACES, SMALL, torch.Generator().manual_seed(0))
    batch = toy_point.segments(5, 1, seed=1, together=0.5)
    with pytest.raises(ValueError, match="never sees actions"):
        train(model, batch, SCHEDULE, torch.Generator())
    batch.observations["proprioception"][4, 0, 0] = torch.inf
    with pytest.raises(ValueError, match="proprioception of segment point-1:4"):
        train(model, batch.without_labels(), SCHEDULE, torch.Generator())


def test_chains_of_pictures_show_one_square_that_moves_a_little() -> None:
    config = replace(SMALL, latent=8)
    model = LatentSubgoalGenerator(toy_robot.PICTURE, config, torch.Generator().manual_seed(0))
    action_free = toy_robot.pictures(500, 2, seed=3).without_labels()
    train(model, action_free, replace(SCHEDULE, steps=500, batch_size=32), torch.Generator().manual_seed(1))
    test = at(toy_robot.pictures(100, 1, seed=2).observations, 0)
    chain = model.sample(test, 3, torch.Generator().manual_seed(2))["camera"]
    assert (chain.shape, chain.dtype) == ((100, 4, 16, 16, 3), torch.uint8)
    light = (chain.float() / 255.0).mean(-1).sum((2, 3))  # of 16 white pixels
    assert float((light[:, 1:] - 16.0).abs().median()) < 8.0
    overlap = (chain[:, 1:].float() * chain[:, :1].float()).mean(-1).sum((2, 3)) / 255.0**2
    assert float(overlap[:, 0].mean()) > 7.0  # of 16: mostly where it was; a square anywhere would have 1.6
    assert float(overlap[:, 0].mean()) > float(overlap[:, 2].mean()) + 1.0  # it goes away from there


def test_it_learns_from_segments_of_a_single_step() -> None:
    generator = torch.Generator().manual_seed(0)
    model = LatentSubgoalGenerator(toy_robot.POINT, SMALL, generator)
    batch = toy_robot.points(50, 1, seed=1).without_labels()
    train(model, batch, TrainingConfig(3, 16, 1e-3, 0.0), generator)
    chain = model.sample(at(batch.observations, 0), 2, generator)
    assert chain["position"].shape == (50, 3, 2)
