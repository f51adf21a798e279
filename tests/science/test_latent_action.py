"""Latent-action inverse dynamics on a point among distractors, and on pictures of one."""

import re
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from models.inverse_dynamics.latent_action import SMALL, LatentActionConfig, LatentActionInverseDynamics
from models.segments import SegmentBatch
from models.spaces import BoxAction, DiscreteAction, Spaces, StreamSpec
from models.training import NonFiniteError, TrainingConfig, TrainingState, advance, begin, train
from tests.science import toy_point, toy_robot

CONFIG = replace(SMALL, width=32)
SCHEDULE = TrainingConfig(steps=400, batch_size=32, learning_rate=3e-3, weight_decay=1e-2)


def _built(config: LatentActionConfig = CONFIG, spaces: Spaces = toy_point.SPACES) -> LatentActionInverseDynamics:
    return LatentActionInverseDynamics(spaces, config, torch.Generator().manual_seed(0))


def _trained(config: LatentActionConfig, action_free: SegmentBatch | None) -> LatentActionInverseDynamics:
    model = _built(config)
    labeled = toy_point.segments(200, 1, seed=1, together=0.5)
    train(model, labeled, SCHEDULE, torch.Generator().manual_seed(1), action_free=action_free)
    return model


@pytest.fixture(scope="module")
def action_free() -> SegmentBatch:
    return toy_point.segments(1000, 1, seed=2, together=0.0).without_labels()


@pytest.fixture(scope="module")
def new_combinations() -> SegmentBatch:
    """Distractors that go ways of their own, where they went along with the point in all labels."""
    return toy_point.segments(400, 1, seed=3, together=0.0)


@pytest.fixture(scope="module")
def sparse(action_free: SegmentBatch) -> LatentActionInverseDynamics:
    return _trained(CONFIG, action_free)


def _errors(model: LatentActionInverseDynamics, batch: SegmentBatch) -> tuple[float, float]:
    """Mean squared error of the point's way, and share of signs that are right."""
    assert batch.actions is not None
    with torch.no_grad():
        inferred = model.infer(batch.observations)
    wrong = (inferred - batch.actions)[..., :2].square().mean()
    signs = (inferred[..., 2] > 0) == (batch.actions[..., 2] > 0)
    return float(wrong), float(signs.float().mean())


def test_the_sparse_form_recovers_actions_in_new_combinations_and_better_than_the_dense_one(
    sparse: LatentActionInverseDynamics, action_free: SegmentBatch, new_combinations: SegmentBatch
) -> None:
    dense = _trained(replace(CONFIG, sparsity=0.0), action_free)
    known = toy_point.segments(400, 1, seed=4, together=0.5)
    assert (sparse.kind, dense.kind) == ("inverse_dynamics", "dense_inverse_dynamics")
    assert max(_errors(sparse, known)[0], _errors(dense, known)[0]) < 0.1  # of a variance of 1/3
    (wrong, signs), (dense_wrong, _) = _errors(sparse, new_combinations), _errors(dense, new_combinations)
    assert signs > 0.98
    assert wrong < 0.15
    assert wrong < 0.8 * dense_wrong


def test_unlabeled_segments_help_reconstruction(
    sparse: LatentActionInverseDynamics, new_combinations: SegmentBatch
) -> None:
    alone = _trained(CONFIG, None)
    with torch.no_grad():
        helped, without = (m.reconstruction_error(new_combinations.observations).mean() for m in (sparse, alone))
    assert float(helped) < 0.8 * float(without)


def test_the_action_decoder_is_updated_at_every_second_step(action_free: SegmentBatch) -> None:
    model, labeled = _built(), toy_point.segments(50, 1, seed=1, together=0.5)
    state = begin(model, SCHEDULE, torch.Generator().manual_seed(1))
    actors, encoders = [_weights(model, "actor.")], [_weights(model, "encoder.")]
    for step in range(1, 5):
        state = advance(model, labeled, state, step, action_free=action_free)
        actors.append(_weights(model, "actor."))
        encoders.append(_weights(model, "encoder."))
    assert [torch.equal(*two) for two in pairwise(actors)] == [True, False, True, False]
    assert not any(torch.equal(*two) for two in pairwise(encoders))


@pytest.mark.parametrize("cuts", [(1, 3), (2, 5)])
def test_interrupted_training_equals_uninterrupted_training(cuts: tuple[int, ...], action_free: SegmentBatch) -> None:
    labeled = toy_point.segments(50, 3, seed=1, together=0.5)
    longer = toy_point.segments(50, 3, seed=2, together=0.0).without_labels()
    config = replace(CONFIG, window=3)
    start = begin(_built(config), SCHEDULE, torch.Generator().manual_seed(7))
    end = advance(_built(config), labeled, start, 6, action_free=longer)
    state = start
    for step in (*cuts, 6):
        state = advance(_built(config), labeled, TrainingState.from_bytes(state.to_bytes()), step, action_free=longer)
    assert state.tensors.keys() == end.tensors.keys()
    assert all(torch.equal(state.tensors[name], end.tensors[name]) for name in end.tensors)


def test_a_latent_action_depends_on_no_later_observation() -> None:
    model, batch = _built(), toy_point.segments(4, 5, seed=1, together=0.5)
    later = {name: stream.clone() for name, stream in batch.observations.items()}
    for stream in later.values():
        stream[:, 4:] += 3.0
    with torch.no_grad():
        before, after = model.encode(batch.observations), model.encode(later)
    assert torch.equal(before[:, :3], after[:, :3])
    assert not torch.allclose(before[:, 3], after[:, 3])


def test_many_segments_are_read_as_each_alone_is() -> None:
    model, batch = _built(), toy_point.segments(200, 5, seed=1, together=0.5)
    with torch.no_grad():
        alone = model.encode(batch.take(slice(170, 171)).observations)
        torch.testing.assert_close(model.encode(batch.observations)[170:171], alone)


def test_pictures_alone_tell_where_the_point_was_sent() -> None:
    model = _built(replace(CONFIG, patch=4), toy_robot.PICTURE)
    generator, labeled = torch.Generator().manual_seed(0), toy_robot.pictures(300, 1, seed=1)
    train(model, labeled, replace(SCHEDULE, steps=200), generator)
    test = toy_robot.pictures(200, 1, seed=2)
    with torch.no_grad():
        inferred = model.infer(test.observations)
        seen = model.reconstruct(test.observations, model.encode(test.observations))["camera"]
        assert float(model.reconstruction_error(test.observations).mean()) < 0.9
    assert test.actions is not None
    assert inferred.shape == (200, 1, 2)
    assert float((inferred - test.actions).square().mean()) < 0.25  # of 1/3; the pixels are an action of 0.8 apart
    assert (seen.shape, seen.dtype) == ((200, 1, 16, 16, 3), torch.uint8)


def test_a_number_that_is_not_finite_is_refused_by_the_name_of_its_segment() -> None:
    batch = toy_point.segments(5, 1, seed=1, together=0.5)
    batch.observations["objects"][3, 1, 2] = torch.nan
    with pytest.raises(ValueError, match="objects of segment point-1:3"):
        train(_built(), batch, SCHEDULE, torch.Generator())


def test_a_loss_that_is_not_finite_names_labeled_and_action_free_segments(action_free: SegmentBatch) -> None:
    model, labeled = _built(), toy_point.segments(2, 1, seed=1, together=0.5)
    with torch.no_grad():
        model.question.fill_(torch.nan)
    with pytest.raises(
        NonFiniteError, match=r"inverse_dynamics is nan at step 0; .*point-1:1.*point-2:\d+ \(action-free"
    ):
        train(model, labeled, SCHEDULE, torch.Generator(), action_free=action_free)


def test_actions_outside_of_the_box_are_refused_by_the_name_of_their_segment() -> None:
    batch = toy_point.segments(5, 1, seed=1, together=0.5)
    assert batch.actions is not None
    batch.actions[2] = 1.5
    with pytest.raises(ValueError, match=r"point-1:2 is outside of \[-1, 1\]"):
        train(_built(), batch, SCHEDULE, torch.Generator())


def test_actions_of_another_box_are_told_in_it() -> None:
    spaces = Spaces(toy_point.SPACES.observations, BoxAction(10.0, 30.0, (3,), (2,)))
    one = toy_point.segments(200, 1, seed=1, together=0.5)
    assert one.actions is not None
    other = replace(one, actions=20.0 + 10.0 * one.actions)
    schedule, found = replace(SCHEDULE, steps=20), []
    for batch, model in ((one, _built()), (other, _built(spaces=spaces))):
        train(model, batch, schedule, torch.Generator().manual_seed(1))
        with torch.no_grad():
            found.append(model.infer(one.observations))
    torch.testing.assert_close(found[1], 20.0 + 10.0 * found[0], atol=1e-3, rtol=0.0)
    assert set(found[1][..., 2].flatten().tolist()) <= {10.0, 30.0}


@pytest.mark.parametrize(
    ("spaces", "config", "message"),
    [
        (Spaces(toy_point.SPACES.observations, DiscreteAction(7)), CONFIG, "box of shape (D,)"),
        (Spaces(toy_point.SPACES.observations, BoxAction(1.0, 1.0, (3,))), CONFIG, "bounded box of shape (D,)"),
        (Spaces({"grid": StreamSpec((5, 5), "int64")}, toy_robot.ACTION), CONFIG, "int64 (5, 5)"),
        (toy_robot.PICTURE, replace(CONFIG, patch=5), "not covered by patches of 5"),
        (Spaces(toy_point.SPACES.observations, BoxAction(-1.0, 1.0, (3,), (3,))), CONFIG, "of 3 numbers, got (3,)"),
    ],
)
def test_spaces_that_do_not_fit_are_refused(spaces: Spaces, config: LatentActionConfig, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        _built(config, spaces)


def _weights(model: LatentActionInverseDynamics, part: str) -> Tensor:
    return torch.cat([w.detach().flatten().clone() for name, w in model.named_parameters() if name.startswith(part)])
