"""Every prefix of a diversified order is a good batch."""

import pytest
import torch

from models.acquisition import Models, diversify, features, top
from models.acquisition.diversification import CANDIDATES_PER_PICK, FEWEST_CANDIDATES
from models.inverse_dynamics.base import DiscreteInverseDynamics
from models.segments import SegmentBatch
from models.world_models.grid import GridWorldModel


def _clusters(each: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    centres = 100 * torch.eye(5)
    labels = torch.arange(5).repeat_interleave(each)
    return centres[labels] + 0.01 * torch.randn(5 * each, 5, generator=generator), labels


def test_the_first_five_picks_are_in_five_clusters() -> None:
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        points, labels = _clusters(40, generator)
        order = diversify(torch.rand(200, generator=generator) + 0.1, points, 50, generator)
        assert sorted(labels[order[:5]].tolist()) == [0, 1, 2, 3, 4]
        assert len(set(order.tolist())) == 50


def test_a_higher_score_is_picked_first_among_equals_more_often() -> None:
    scores, firsts = torch.tensor([16.0, 1.0]), []
    for seed in range(500):
        firsts.append(int(diversify(scores, torch.eye(2), 1, torch.Generator().manual_seed(seed))[0]))
    assert 0.14 < sum(firsts) / 500 < 0.26  # sqrt(1) / (sqrt(16) + sqrt(1)) = 0.2


def test_duplicates_follow_by_score() -> None:
    points = torch.tensor([[0.0], [0.0], [0.0], [1.0]])
    order = diversify(torch.tensor([1.0, 3.0, 2.0, 1.0]), points, 4, torch.Generator().manual_seed(0))
    first_two, rest = order[:2].tolist(), order[2:].tolist()
    assert 3 in first_two
    assert rest == sorted(rest, key=lambda index: -[1.0, 3.0, 2.0, 1.0][index])


def test_without_features_the_order_is_by_score() -> None:
    assert diversify(torch.tensor([1.0, 3.0, 2.0]), None, 2, torch.Generator()).tolist() == [1, 2]
    assert features(Models(), SegmentBatch({"x": torch.zeros(3, 2)})) is None


def test_scores_of_zero_still_give_an_order() -> None:
    order = diversify(torch.zeros(4), torch.eye(4), 3, torch.Generator().manual_seed(0))
    assert len(set(order.tolist())) == 3


def test_a_negative_score_is_refused() -> None:
    with pytest.raises(ValueError, match=r"at least 0 to weigh candidates, got -1\.0"):
        diversify(torch.tensor([-1.0, 1.0]), torch.eye(2), 1, torch.Generator())


def test_features_tell_turning_from_moving(
    world_model: GridWorldModel, inverse_dynamics: DiscreteInverseDynamics, held_out: SegmentBatch
) -> None:
    assert held_out.actions is not None
    points = features(Models(world_model, inverse_dynamics), held_out)
    assert points is not None
    turn, move = points[held_out.actions[:, 0] == 0], points[held_out.actions[:, 0] == 2]
    within = torch.cdist(turn[:20], turn[20:40]).mean()
    assert float(torch.cdist(turn[:20], move[:20]).mean()) > float(within)


def test_top_keeps_ties_in_order() -> None:
    assert top(torch.tensor([1.0, 2.0, 2.0, 0.0]), 3).tolist() == [1, 2, 0]


def test_a_short_prefix_comes_from_the_highest_scores_however_long_the_queue() -> None:
    generator = torch.Generator().manual_seed(0)
    scores, points = torch.linspace(1.0, 0.5, 2000), torch.randn(2000, 8, generator=generator)
    order = diversify(scores, points, 2000, generator)
    assert int(order[:20].max()) < FEWEST_CANDIDATES
    assert int(order[:200].max()) < 200 * CANDIDATES_PER_PICK
    assert sorted(order.tolist()) == list(range(2000))
