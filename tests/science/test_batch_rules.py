"""What holds for every batch rule, and what each is for: every prefix of its order is a good batch."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from models.acquisition import BATCH_RULES, STRATEGIES, Candidates, Models, describe, top
from models.acquisition.batch_rules.kmeans_plus_plus import FEWEST_CANDIDATES, KMeansPlusPlus
from models.acquisition.batch_rules.rank_noise import RankNoise
from models.inverse_dynamics.base import DiscreteInverseDynamics
from models.segments import SegmentBatch
from models.world_models.grid import GridWorldModel
from tests.science import toy_grid

DIVERSE = ("kmeans_plus_plus", "k_center", "signatures")


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _clusters(each: int, generator: torch.Generator) -> tuple[Candidates, Tensor]:
    """Five far clusters, whose members share a signature, and their numbers."""
    labels = torch.arange(5).repeat_interleave(each)
    points = 100 * torch.eye(5)[labels] + 0.01 * torch.randn(5 * each, 5, generator=generator)
    return Candidates(torch.rand(5 * each, generator=generator) + 0.1, points, labels.unsqueeze(1)), labels


@pytest.mark.parametrize("name", BATCH_RULES)
@pytest.mark.parametrize("count", [0, 1, 37, 200, 500])
def test_a_rule_orders_candidates_without_repeating_any(name: str, count: int) -> None:
    candidates, _ = _clusters(40, _generator())
    order = BATCH_RULES[name].order(candidates, count, _generator(1))
    assert BATCH_RULES[name].name == name
    assert order.dtype == torch.int64
    assert len(set(order.tolist())) == len(order) == min(count, 200)
    assert torch.equal(order, BATCH_RULES[name].order(candidates, count, _generator(1)))


@pytest.mark.parametrize("name", BATCH_RULES)
@pytest.mark.parametrize("scores", [[], [0.0] * 6, [-3.0, -1.0, -2.0, -5.0, -4.0, -6.0], [1.0] * 6])
def test_a_rule_takes_any_finite_scores(name: str, scores: list[float]) -> None:
    count = len(scores)
    candidates = Candidates(torch.tensor(scores), torch.eye(6)[:count], torch.arange(count).unsqueeze(1) // 2)
    assert sorted(BATCH_RULES[name].order(candidates, 6, _generator()).tolist()) == list(range(count))


@pytest.mark.parametrize("name", [name for name in BATCH_RULES if name != "rank_noise"])
def test_without_a_description_the_order_is_by_score(name: str) -> None:
    assert BATCH_RULES[name].order(Candidates(torch.tensor([1.0, 3.0, 2.0])), 2, _generator()).tolist() == [1, 2]


@pytest.mark.parametrize("name", DIVERSE)
def test_the_first_five_picks_are_in_five_clusters(name: str) -> None:
    for seed in range(20):
        generator = _generator(seed)
        candidates, labels = _clusters(40, generator)
        order = BATCH_RULES[name].order(candidates, 50, generator)
        assert sorted(labels[order[:5]].tolist()) == [0, 1, 2, 3, 4]
    best = int(candidates.scores.argmax())
    assert name == "kmeans_plus_plus" or int(order[0]) == best


def test_a_higher_score_is_picked_first_among_equals_more_often() -> None:
    candidates = Candidates(torch.tensor([16.0, 1.0]), torch.eye(2))
    firsts = [int(KMeansPlusPlus().order(candidates, 1, _generator(seed))[0]) for seed in range(500)]
    assert 0.14 < sum(firsts) / 500 < 0.26  # sqrt(1) / (sqrt(16) + sqrt(1)) = 0.2


@pytest.mark.parametrize("name", ["kmeans_plus_plus", "k_center"])
def test_duplicates_follow_by_score(name: str) -> None:
    scores = [1.0, 3.0, 2.0, 1.0]
    points = torch.tensor([[0.0], [0.0], [0.0], [1.0]])
    order = BATCH_RULES[name].order(Candidates(torch.tensor(scores), points), 4, _generator()).tolist()
    assert 3 in order[:2]
    assert order[2:] == sorted(order[2:], key=lambda index: -scores[index])


def test_a_short_prefix_comes_from_the_highest_scores_however_long_the_queue() -> None:
    generator = _generator()
    candidates = Candidates(torch.linspace(1.0, 0.5, 2000), torch.randn(2000, 8, generator=generator))
    for rule in (BATCH_RULES["kmeans_plus_plus"], BATCH_RULES["k_center"]):
        order = rule.order(candidates, 2000, generator)
        assert int(order[:20].max()) < FEWEST_CANDIDATES
        assert int(order[:200].max()) < 200 * KMeansPlusPlus().candidates_per_pick
        assert sorted(order.tolist()) == list(range(2000))


def test_rank_noise_draws_by_rank() -> None:
    """The first of three is drawn with probability 1/rank over the sum: 6/11, 3/11, 2/11."""
    candidates = Candidates(torch.tensor([5.0, 9.0, 1.0]))
    firsts = [int(RankNoise().order(candidates, 1, _generator(seed))[0]) for seed in range(3000)]
    share = torch.bincount(torch.tensor(firsts), minlength=3) / 3000
    torch.testing.assert_close(share, torch.tensor([3.0, 6.0, 2.0]) / 11, atol=0.03, rtol=0)
    quiet = replace(RankNoise(), beta=1e6)
    assert quiet.order(candidates, 3, _generator()).tolist() == [1, 0, 2]


def test_signatures_go_round_by_their_best_score() -> None:
    scores = torch.tensor([9.0, 8.0, 7.0, 6.0, 5.0])
    signatures = torch.tensor([[1, 0], [1, 0], [1, 1], [1, 0], [1, 1]])
    order = BATCH_RULES["signatures"].order(Candidates(scores, None, signatures), 5, _generator())
    assert order.tolist() == [0, 2, 1, 4, 3]


def test_descriptions_must_fit_the_scores() -> None:
    with pytest.raises(ValueError, match=r"features must be \(3, D\) for 3 scores, got \(2, 2\)"):
        Candidates(torch.zeros(3), torch.eye(2))


def test_top_keeps_ties_in_order() -> None:
    assert top(torch.tensor([1.0, 2.0, 2.0, 0.0]), 3).tolist() == [1, 2, 0]


@pytest.fixture
def models(world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics) -> Models:
    return Models(world_model, inverse_dynamics)


def test_features_tell_turning_from_moving(models: Models, held_out: SegmentBatch) -> None:
    points = _described("kmeans_plus_plus", "cycle", models, held_out).features
    assert points is not None
    assert held_out.actions is not None
    turn, move = points[held_out.actions[:, 0] == 0], points[held_out.actions[:, 0] == 2]
    within = torch.cdist(turn[:20], turn[20:40]).mean()
    assert float(torch.cdist(turn[:20], move[:20]).mean()) > float(within)


def test_signatures_tell_what_happened_and_not_where(models: Models) -> None:
    batch = toy_grid.labeled(400, seed=5)
    found = _described("signatures", "oracle", models, batch).signatures
    assert found is not None
    assert batch.actions is not None
    turns = found[batch.actions[:, 0] == 0]
    empty = turns[(turns[:, 1] == turns[0, 1]) & (turns[:, 2] == turns[0, 2])]
    assert len(empty) > 1  # the same turn before the same thing, in several places
    assert len(torch.unique(found, dim=0)) < batch.size


def test_what_looks_at_no_actions_is_not_described(models: Models, held_out: SegmentBatch) -> None:
    assert _described("kmeans_plus_plus", "random", models, held_out).features is None
    assert _described("kmeans_plus_plus", "cycle", models, held_out.take(slice(0, 0))).features is None
    assert _described("top", "cycle", models, held_out).features is None


def _described(rule: str, strategy: str, models: Models, batch: SegmentBatch) -> Candidates:
    return describe(BATCH_RULES[rule], STRATEGIES[strategy], models, batch, torch.zeros(batch.size))
