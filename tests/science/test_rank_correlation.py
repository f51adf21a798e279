"""Rank correlation against published values, against a count of all pairs, and where it is not defined."""

import math

import pytest
import torch
from torch import Tensor

from models.rank_correlation import average_ranks, kendall, spearman


def test_known_values() -> None:
    """From scipy's documentation of spearmanr and kendalltau."""
    assert spearman(torch.arange(1, 6), torch.tensor([5, 6, 7, 8, 7])) == pytest.approx(0.8207826816681233)
    tau = kendall(torch.tensor([12, 2, 1, 12, 2]), torch.tensor([1, 4, 7, 1, 0]))
    assert tau == pytest.approx(-0.47140452079103173)


def test_the_same_order_is_one_and_the_reverse_minus_one() -> None:
    values = torch.tensor([0.3, -2.0, 7.5, 1.0])
    for correlation in (spearman, kendall):
        assert correlation(values, values.exp()) == pytest.approx(1.0)
        assert correlation(values, -values) == pytest.approx(-1.0)


def test_equal_values_share_the_mean_of_their_ranks() -> None:
    assert average_ranks(torch.tensor([5.0, 1.0, 5.0, 2.0, 5.0])).tolist() == [4, 1, 4, 2, 4]


@pytest.mark.parametrize("count", [2, 3, 7, 64, 100, 257])
@pytest.mark.parametrize("values", [3, 1000])
def test_both_agree_with_their_definitions(count: int, values: int) -> None:
    generator = torch.Generator().manual_seed(count * values)
    left, right = torch.randint(values, (2, count), generator=generator).double()
    right = right + left * torch.randint(2, (count,), generator=generator)
    if len(left.unique()) > 1 and len(right.unique()) > 1:
        assert kendall(left, right) == pytest.approx(_of_all_pairs(left, right))
        ranks = torch.stack([_rank_by_counting(left), _rank_by_counting(right)])
        assert spearman(left, right) == pytest.approx(float(torch.corrcoef(ranks)[0, 1]))


def _of_all_pairs(left: Tensor, right: Tensor) -> float:
    signs = [(values.unsqueeze(1) - values.unsqueeze(0)).sign() for values in (left, right)]
    untied = [float(sign.abs().sum()) for sign in signs]
    return float((signs[0] * signs[1]).sum()) / math.sqrt(untied[0] * untied[1])


def _rank_by_counting(values: Tensor) -> Tensor:
    smaller = (values.unsqueeze(0) < values.unsqueeze(1)).sum(1)
    return smaller + ((values.unsqueeze(0) == values.unsqueeze(1)).sum(1) + 1) / 2


def test_it_is_unknown_where_nothing_can_be_ranked() -> None:
    for left, right in (([], []), ([1.0], [2.0]), ([1.0, 1.0], [1.0, 2.0]), ([1.0, 2.0], [0.0, 0.0])):
        assert spearman(torch.tensor(left), torch.tensor(right)) is None
        assert kendall(torch.tensor(left), torch.tensor(right)) is None


def test_what_cannot_be_ranked_is_refused() -> None:
    for correlation in (spearman, kendall):
        with pytest.raises(ValueError, match="right must be finite to be ranked, got nan at 1"):
            correlation(torch.zeros(2), torch.tensor([0.0, math.nan]))
        with pytest.raises(ValueError, match=r"alike, got \(2,\) and \(3,\)"):
            correlation(torch.zeros(2), torch.zeros(3))


def test_ten_thousand_values_need_no_table_of_pairs() -> None:
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(10_000, generator=generator)
    noisy = values + torch.rand(10_000, generator=generator)
    rho, tau = spearman(values, noisy), kendall(values, noisy)
    assert rho is not None
    assert tau is not None
    assert 0.4 < tau < rho < 0.8
