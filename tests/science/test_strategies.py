"""What holds for every strategy in the registry."""

import pytest
import torch
from torch import Tensor

from models.acquisition import STRATEGIES, Models, NonFiniteScoreError, Strategy, score_pool
from models.families import GRID
from models.inverse_dynamics.base import DiscreteInverseDynamics
from models.network import KINDS
from models.segments import SegmentBatch
from models.world_models.grid import GridWorldModel
from tests.science import toy_grid


@pytest.fixture(scope="module")
def models(world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics) -> Models:
    generator = torch.Generator().manual_seed(4)
    dense = GRID.build_inverse_dynamics(toy_grid.SPACES, "dense", None, generator)
    rival = GRID.build_world_model(toy_grid.SPACES, None, generator)
    return Models(world_model, inverse_dynamics, dense, (world_model, rival))


@pytest.fixture(scope="module")
def pool() -> SegmentBatch:
    return toy_grid.labeled(150, seed=11)


def _score(strategy: Strategy, models: Models, batch: SegmentBatch) -> Tensor:
    return score_pool(strategy, models, batch.without_labels(), torch.Generator().manual_seed(0), chunk=64)


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_strategy_gives_each_segment_one_finite_score_and_repeats_it(
    name: str, models: Models, pool: SegmentBatch
) -> None:
    strategy = STRATEGIES[name]
    scores = _score(strategy, models, pool)
    assert strategy.name == name
    assert strategy.needs <= {*KINDS, "ensemble"}
    assert scores.shape == (pool.size,)
    assert scores.dtype in (torch.float32, torch.float64)
    assert bool(torch.isfinite(scores).all())
    assert float(scores.min()) >= 0
    assert torch.equal(scores, _score(strategy, models, pool))
    assert len(set(scores.tolist())) > pool.size // 4


@pytest.mark.parametrize("name", [name for name in STRATEGIES if name != "random"])
def test_a_score_does_not_depend_on_the_rest_of_the_batch(name: str, models: Models, pool: SegmentBatch) -> None:
    shuffled = torch.randperm(pool.size, generator=torch.Generator().manual_seed(1))
    scores = _score(STRATEGIES[name], models, pool)
    torch.testing.assert_close(_score(STRATEGIES[name], models, pool.take(shuffled)), scores[shuffled])


@pytest.mark.parametrize("name", [name for name, strategy in STRATEGIES.items() if strategy.needs])
def test_a_strategy_names_the_models_it_misses(name: str, pool: SegmentBatch) -> None:
    with pytest.raises(ValueError, match=f"Strategy {name} needs .*{min(STRATEGIES[name].needs)}"):
        _score(STRATEGIES[name], Models(), pool)


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
