"""The cycle over segments of several steps of a robot: actions in a box, distances in a latent space."""

import pytest
import torch

from models.acquisition import BATCH_RULES, EXPLORING, STRATEGIES, Models, score_pool
from models.cycle_consistency import cycle, cycle_error, worst_chain
from models.evaluation import transition_errors
from models.exploration import CHAINS, IMAGINED, STATES, asked, explore, looks, states_to_look_at
from models.exploration_queue import order
from models.inverse_dynamics.latent_gates import SMALL, LatentMaskedInverseDynamics
from models.rank_correlation import spearman
from models.segments import SegmentBatch, at
from models.spaces import DiscreteAction
from models.step_distances import nearest_true_actions
from models.subgoal_generators import latent
from models.subgoal_generators.latent import LatentSubgoalGenerator
from models.training import TrainingConfig, train
from models.world_models.recurrent import RecurrentWorldModel
from tests.science import toy_robot

LENGTH = 4


@pytest.fixture(scope="module")
def pool() -> SegmentBatch:
    return toy_robot.points(400, LENGTH, seed=2)


@pytest.fixture(scope="module")
def models() -> Models:
    """The world model has seen slow points alone; the inverse dynamics and the subgoal generator have seen all."""
    generator, everything = torch.Generator().manual_seed(0), toy_robot.points(400, LENGTH, seed=1)
    assert everything.actions is not None
    slow = everything.take((everything.actions.abs().amax((1, 2)) < 0.9).nonzero().flatten())
    world_model = RecurrentWorldModel(toy_robot.POINT, toy_robot.TINY, generator)
    train(world_model, slow, TrainingConfig(250, 32, 1e-2, 0.0, clip=100.0), generator)
    inverse = LatentMaskedInverseDynamics(toy_robot.POINT, SMALL, generator)
    train(inverse, everything, TrainingConfig(500, 32, 1e-2, 1e-2), generator)
    subgoals = LatentSubgoalGenerator(toy_robot.POINT, latent.SMALL, generator)
    train(subgoals, everything.without_labels(), TrainingConfig(400, 64, 3e-3, 1e-4), generator)
    return Models(world_model, inverse, masked_inverse_dynamics=inverse, subgoal_generator=subgoals)


def test_the_score_of_observed_chains_ranks_as_the_true_loss_does(models: Models, pool: SegmentBatch) -> None:
    assert models.world_model is not None
    assert models.inverse_dynamics is not None
    score = cycle_error(models.world_model, models.inverse_dynamics, pool.observations)
    loss = nearest_true_actions(models.world_model, pool)[1]
    assert bool((score >= 0).all())
    assert (spearman(score, loss) or 0.0) > 0.7


def test_explore_mode_proposes_the_worst_chain_of_every_state(models: Models, pool: SegmentBatch) -> None:
    states = at(pool.take(slice(0, 30)).observations, 0)
    found = explore(EXPLORING["cycle"], models, states, LENGTH, torch.Generator().manual_seed(5), chunk=20)
    assert found.actions.shape == (30, LENGTH, 2)
    assert bool((found.actions.abs() <= 1).all())
    assert found.states.tolist() == list(range(30))
    best = order(BATCH_RULES["top"], models, states, found, 5, torch.Generator())
    assert best.tolist() == found.scores.argsort(descending=True)[:5].tolist()
    look = looks(states)[int(best[0])]
    done = asked(look, found.actions[best[0]].tolist())
    assert len(found.without(looks(states), {done}).scores) == 29


def test_fewer_states_are_looked_at_where_chains_are_long() -> None:
    assert states_to_look_at(DiscreteAction(7), 32) == STATES
    assert states_to_look_at(toy_robot.ACTION, 1) == STATES
    assert states_to_look_at(toy_robot.ACTION, 32) == IMAGINED // CHAINS // 32


def test_of_generated_chains_the_worst_is_kept_with_its_actions(models: Models, pool: SegmentBatch) -> None:
    assert models.world_model is not None
    assert models.inverse_dynamics is not None
    assert models.subgoal_generator is not None
    parts = models.world_model, models.inverse_dynamics, models.subgoal_generator
    states = at(pool.take(slice(0, 50)).observations, 0)
    worst = worst_chain(*parts, states, 4, LENGTH, torch.Generator().manual_seed(5))
    again, errors = torch.Generator().manual_seed(5), []
    for _ in range(4):
        errors.append(cycle_error(*parts[:2], parts[2].sample(states, LENGTH, again)))
    assert torch.equal(worst.error, torch.stack(errors).amax(0))
    assert worst.actions.shape == (50, LENGTH, 2)
    assert float(worst.actions.abs().max()) <= 1.0
    torch.testing.assert_close(cycle(*parts[:2], worst.chain)[0], worst.actions)


@pytest.mark.parametrize("name", ["cycle", "masked_cycle", "confident_cycle", "fidelity", "reachability", "oracle"])
def test_strategies_score_segments_of_a_box(name: str, models: Models, pool: SegmentBatch) -> None:
    scores = score_pool(STRATEGIES[name], models, pool.take(slice(0, 20)), torch.Generator().manual_seed(0))
    assert scores.shape == (20,)
    assert float(scores.std()) > 0.0


@pytest.mark.parametrize("name", ["self_inverse", "forward_cycle"])
def test_strategies_that_try_every_action_refuse_a_box(name: str, models: Models, pool: SegmentBatch) -> None:
    with pytest.raises(ValueError, match="BoxAction"):
        score_pool(STRATEGIES[name], models, pool, torch.Generator())


def test_the_inverse_accuracy_of_a_box_counts_numbers(models: Models, pool: SegmentBatch) -> None:
    assert models.world_model is not None
    right = transition_errors(models.world_model, pool, models.inverse_dynamics).inverse_correct
    assert right is not None
    assert set(right.unique().tolist()) <= {0.0, 0.5, 1.0}  # type: ignore[no-untyped-call]  # untyped in torch
    assert float(right.mean()) > 0.7
