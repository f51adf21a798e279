"""What holds for every strategy in the registry."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from models.acquisition import STRATEGIES, Models, NonFiniteScoreError, Strategy, score_pool
from models.acquisition.base import FIRST_ROUND_LACKS
from models.acquisition.confident_cycle import ConfidentCycle
from models.families import GRID
from models.inverse_dynamics.base import ActionProbabilities, DiscreteInverseDynamics
from models.network import KINDS
from models.segments import Observations, SegmentBatch
from models.training import TrainingConfig, train
from models.world_models.grid import GridWorldModel
from tests.science import toy_grid


@pytest.fixture(scope="module")
def unsure(training_set: SegmentBatch) -> GridWorldModel:
    """Has seen a little of every action. One that is certain gives many segments one score, to the last bit."""
    generator = torch.Generator().manual_seed(5)
    model = GRID.build_world_model(toy_grid.SPACES, None, generator)
    train(model, training_set.take(slice(0, 500)), TrainingConfig(100, 32, 1e-2, 1e-2), generator)
    return model


@pytest.fixture(scope="module")
def models(world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics) -> Models:
    generator = torch.Generator().manual_seed(4)
    dense = GRID.build_inverse_dynamics(toy_grid.SPACES, "dense", None, generator)
    rival = GRID.build_world_model(toy_grid.SPACES, None, generator)
    return Models(
        world_model,
        inverse_dynamics,
        dense,
        masked_inverse_dynamics=GRID.build_inverse_dynamics(toy_grid.SPACES, "masked", None, generator),
        subgoal_generator=GRID.build_subgoal_generator(toy_grid.SPACES, None, generator),
        previous_world_model=rival,
        ensemble=(world_model, rival),
    )


@pytest.fixture(scope="module")
def pool() -> SegmentBatch:
    return toy_grid.labeled(150, seed=11)


def _score(strategy: Strategy, models: Models, batch: SegmentBatch) -> Tensor:
    seen = batch if strategy.privileged else batch.without_labels()
    return score_pool(strategy, models, seen, torch.Generator().manual_seed(0), chunk=64)


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_strategy_gives_each_segment_one_finite_score_and_repeats_it(
    name: str, models: Models, unsure: GridWorldModel, pool: SegmentBatch
) -> None:
    strategy, models = STRATEGIES[name], replace(models, world_model=unsure)
    scores = _score(strategy, models, pool)
    assert strategy.name == name
    assert strategy.needs <= {*KINDS, "ensemble", *FIRST_ROUND_LACKS}
    assert scores.shape == (pool.size,)
    assert scores.dtype in (torch.float32, torch.float64)
    assert bool(torch.isfinite(scores).all())
    assert float(scores.min()) >= 0 or "progress" in name  # a world model can become worse
    assert torch.equal(scores, _score(strategy, models, pool))
    assert len(set(scores.tolist())) > pool.size // 4


@pytest.mark.parametrize("name", [name for name in STRATEGIES if name not in ("random", "fidelity", "oracle_uniform")])
def test_a_score_does_not_depend_on_the_rest_of_the_batch(name: str, models: Models, pool: SegmentBatch) -> None:
    shuffled = torch.randperm(pool.size, generator=torch.Generator().manual_seed(1))
    scores = _score(STRATEGIES[name], models, pool)
    again = _score(STRATEGIES[name], models, pool.take(shuffled))
    torch.testing.assert_close(again, scores[shuffled], rtol=1e-5, atol=1e-5)  # of networks in single precision


@pytest.mark.parametrize("name", [name for name, strategy in STRATEGIES.items() if strategy.needs])
def test_a_strategy_names_the_models_it_misses(name: str, pool: SegmentBatch) -> None:
    needed = min(STRATEGIES[name].needs - FIRST_ROUND_LACKS)
    with pytest.raises(ValueError, match=f"Strategy {name} needs .*{needed}"):
        _score(STRATEGIES[name], Models(), pool)


@pytest.mark.parametrize("name", [name for name in STRATEGIES if name != "random"])
def test_a_strategy_says_under_which_actions_it_looks(name: str, models: Models, pool: SegmentBatch) -> None:
    actions = STRATEGIES[name].actions(models, pool)
    assert actions is not None
    assert (tuple(actions.shape), actions.dtype) == ((pool.size, 1), torch.int64)
    if STRATEGIES[name].privileged:
        assert bool(pool.explanations(toy_grid.ACTIONS).gather(2, actions.unsqueeze(2)).all())


@pytest.mark.parametrize("name", [name for name, strategy in STRATEGIES.items() if strategy.privileged])
def test_a_privileged_strategy_says_that_it_needs_the_actions(name: str, models: Models, pool: SegmentBatch) -> None:
    with pytest.raises(ValueError, match=f"Strategy {name} is privileged: it needs the actions"):
        score_pool(STRATEGIES[name], models, pool.without_labels(), torch.Generator())


def test_the_oracles_read_the_same_loss(models: Models, pool: SegmentBatch) -> None:
    """Hardest first; easiest first; every tenth of the logarithm by turns."""
    loss = _score(STRATEGIES["oracle"], models, pool)
    easy = _score(STRATEGIES["oracle_easy"], models, pool)
    assert torch.equal(loss.argsort(), easy.argsort(descending=True))
    uniform = _score(STRATEGIES["oracle_uniform"], models, pool)
    logarithm = loss.double().clamp(min=1e-4).log()
    interval = ((logarithm - logarithm.min()) / (logarithm.max() - logarithm.min()) * 10).long().clamp(max=9)
    filled = set(interval.tolist())
    firsts = interval[uniform.argsort(descending=True)[: len(filled)]]
    assert sorted(firsts.tolist()) == sorted(filled)


def test_the_own_inverse_is_right_where_the_world_model_is(models: Models, movement_only: SegmentBatch) -> None:
    moves = movement_only.take(slice(0, 100))
    assert moves.action_sets is not None
    inferred = STRATEGIES["self_inverse"].actions(models, moves)
    assert inferred is not None
    right = moves.action_sets.gather(2, inferred.unsqueeze(2)).float().mean()
    assert float(right) > 0.9
    own, cycle = (_score(STRATEGIES[name], models, moves) for name in ("self_inverse", "cycle"))
    assert bool((own <= cycle + 1e-4).all())  # no other action explains a step better


def test_progress_is_the_loss_until_there_is_an_older_model(models: Models, pool: SegmentBatch) -> None:
    first = replace(models, previous_world_model=None)
    loss = _score(STRATEGIES["oracle"], models, pool)
    torch.testing.assert_close(_score(STRATEGIES["true_progress"], first, pool), loss)
    same = replace(models, previous_world_model=models.world_model)
    assert float(_score(STRATEGIES["progress"], same, pool).abs().max()) == 0.0
    worse = Models(models.world_model, previous_world_model=models.previous_world_model)
    older = score_pool(STRATEGIES["oracle"], Models(models.previous_world_model), pool, torch.Generator())
    torch.testing.assert_close(_score(STRATEGIES["true_progress"], worse, pool), older - loss, atol=1e-3, rtol=1e-4)


def test_reachability_is_high_where_the_world_model_ignores_the_action(models: Models) -> None:
    """The world model has seen movement only: what it predicts of an interaction does not look like one."""
    held_out = toy_grid.labeled(300, seed=21, effective=True)
    assert held_out.actions is not None
    scores = _score(STRATEGIES["reachability"], models, held_out)
    moves = held_out.actions[:, 0] < 3
    assert float(scores[~moves].mean()) > 3 * float(scores[moves].mean())


def test_random_scores_are_uniform_and_need_no_model(pool: SegmentBatch) -> None:
    scores = _score(STRATEGIES["random"], Models(), pool)
    assert abs(float(scores.mean()) - 0.5) < 0.1
    assert not torch.equal(
        scores, score_pool(STRATEGIES["random"], Models(), pool, torch.Generator().manual_seed(1), chunk=64)
    )


def test_an_ensemble_of_equals_is_certain(models: Models, pool: SegmentBatch) -> None:
    assert models.world_model is not None
    same = Models(inverse_dynamics=models.inverse_dynamics, ensemble=(models.world_model,) * 3)
    assert float(_score(STRATEGIES["uncertainty"], same, pool).max()) < 1e-3
    assert float(_score(STRATEGIES["uncertainty"], models, pool).min()) > 1e-3


def test_a_non_finite_score_names_its_segment(models: Models, pool: SegmentBatch) -> None:
    class Broken:
        name, privileged, needs = "broken", False, frozenset[str]()

        def actions(self, models: Models, batch: SegmentBatch) -> None:
            return None

        def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
            return torch.where(torch.arange(batch.size) == 3, torch.nan, 1.0)

    with pytest.raises(NonFiniteScoreError, match=r"broken gave nan to Segment\(trajectory='toy-11', start=3\)"):
        score_pool(Broken(), models, pool, torch.Generator(), chunk=1000)


def test_scoring_stops_between_two_chunks(pool: SegmentBatch) -> None:
    told: list[None] = []

    def stop() -> None:
        told.append(None)
        if len(told) == 2:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        score_pool(STRATEGIES["random"], Models(), pool, torch.Generator(), chunk=10, after_each=stop)
    assert len(told) == 2


class Doubting:
    """Inverse dynamics that cannot decide between the action that another finds likeliest and the next in number."""

    def __init__(self, sure: DiscreteInverseDynamics) -> None:
        self._sure = sure

    def log_prob(self, batch: SegmentBatch) -> Tensor:
        best = self._sure.infer(batch.observations)
        log_prob = torch.full((*best.shape, toy_grid.ACTIONS), -torch.inf)
        log_prob.scatter_(2, ((best + 1) % toy_grid.ACTIONS).unsqueeze(2), math.log(0.5) + 1e-3)
        return log_prob.scatter_(2, best.unsqueeze(2), math.log(0.5))

    def infer(self, observations: Observations) -> Tensor:
        return self.log_prob(SegmentBatch(observations)).argmax(-1)


def test_a_doubted_action_is_no_reason_to_ask(models: Models, movement_only: SegmentBatch) -> None:
    """The world model knows movement. Under a wrong action that is only just preferred the cycle error is large."""
    moves = movement_only.take(slice(0, 100))
    sure = models.inverse_dynamics
    assert sure is not None
    doubting = replace(models, inverse_dynamics=Doubting(sure))  # type: ignore[arg-type]  # no more is asked of it
    plain, confident = (_score(STRATEGIES[name], doubting, moves) for name in ("cycle", "confident_cycle"))
    true_actions = _score(STRATEGIES["cycle"], models, moves)
    assert bool((confident <= true_actions + 1e-4).all())
    assert float(plain.median()) > 5 * float(confident.median())


def test_a_sure_inverse_leaves_the_cycle_error_as_it_is(models: Models, pool: SegmentBatch) -> None:
    sure = models.inverse_dynamics
    assert isinstance(sure, ActionProbabilities)
    others = sure.log_prob(pool)[:, 0].sort(1).values[:, -2]  # the second likeliest
    certain = others < math.log(ConfidentCycle.least)
    assert int(certain.sum()) > 20
    plain, confident = (_score(STRATEGIES[name], models, pool) for name in ("cycle", "confident_cycle"))
    torch.testing.assert_close(confident[certain], plain[certain])
