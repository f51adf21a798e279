"""The true loss: how far the world model is under what really happened."""

import torch

from models.acquisition import STRATEGIES, Models, score_pool
from models.segments import SegmentBatch, first
from models.step_distances import nearest_true_actions
from models.world_models.grid import GridWorldModel


def test_the_true_loss_is_the_smallest_over_the_actions_that_explain_a_step(
    world_model: GridWorldModel, training_set: SegmentBatch
) -> None:
    some = training_set.take(slice(0, 200))
    sets = some.explanations(7)
    assert bool((sets.sum(2) > 1).any())
    with torch.inference_mode():
        state = world_model.infer_state(first(some.observations))
        after = {name: stream[:, 1:] for name, stream in some.observations.items()}
        every = [
            world_model.distance(world_model.rollout(state, torch.full((200, 1), action)), after) for action in range(7)
        ]
        actions, loss = nearest_true_actions(world_model, some)
    expected = torch.stack(every, 1).masked_fill(~sets[:, 0], torch.inf).amin(1)
    assert torch.allclose(loss, expected, atol=1e-4)
    assert bool(sets.gather(2, actions.unsqueeze(2)).all())
    assert torch.allclose(torch.stack(every, 1).gather(1, actions).squeeze(1), expected, atol=1e-4)


def test_the_true_loss_of_longer_segments_is_that_of_their_rollout(
    world_model: GridWorldModel, training_set: SegmentBatch
) -> None:
    pairs = training_set.take(slice(0, 9)).observations
    frames = {name: stream.flatten(0, 1).view(3, 6, *stream.shape[2:]) for name, stream in pairs.items()}
    actions = torch.randint(7, (3, 5), generator=torch.Generator().manual_seed(0))
    batch = SegmentBatch(frames, actions)
    with torch.inference_mode():
        prediction = world_model.rollout(world_model.infer_state(first(frames)), actions)
        expected = world_model.distance(prediction, {name: stream[:, 1:] for name, stream in frames.items()})
        nearest, loss = nearest_true_actions(world_model, batch)
    assert torch.allclose(loss, expected, rtol=1e-4)
    assert torch.equal(nearest, actions)


def test_privileged_strategies_do_not_ask_again_for_a_step_that_one_of_its_actions_explains_well(
    world_model: GridWorldModel, training_set: SegmentBatch
) -> None:
    """Whichever of the true actions was written down."""
    several = training_set.explanations(7)[:, 0].sum(1) > 1
    some = training_set.take(several.nonzero().flatten()[:100])
    assert some.size == 100
    others = some.with_drawn_actions(torch.Generator().manual_seed(3))
    assert some.actions is not None
    assert others.actions is not None
    assert not torch.equal(others.actions, some.actions)
    models = Models(world_model, previous_world_model=world_model)
    for name in ("oracle", "oracle_easy", "true_progress"):
        scores = [score_pool(STRATEGIES[name], models, each, torch.Generator()) for each in (some, others)]
        assert torch.equal(*scores)
    oracle = STRATEGIES["oracle"]
    assert torch.equal(score_pool(oracle, models, some, torch.Generator()), nearest_true_actions(world_model, some)[1])
    said = oracle.actions(models, some)
    assert said is not None
    assert torch.equal(said, nearest_true_actions(world_model, others)[0])
