"""Means with intervals, the paired test and labels saved, against values known from elsewhere."""

import math
import statistics

import pytest

from benchmarks.paper.statistics import EXACT, estimate, labels_to_reach, paired_p


def test_an_interval_is_that_of_students_t() -> None:
    """Five values: the 97.5 % quantile for 4 degrees of freedom is 2.776."""
    values = [1.0, 2.0, 4.0, 4.0, 9.0]
    found = estimate(values)
    assert found.mean == pytest.approx(4.0)
    assert found.half_width == pytest.approx(2.776 * statistics.stdev(values) / math.sqrt(5))


def test_equal_values_have_no_width_and_a_single_one_has_no_end() -> None:
    assert estimate([3.0, 3.0, 3.0]).half_width == 0.0
    assert estimate([3.0]).half_width == math.inf


def test_no_seed_is_no_estimate() -> None:
    with pytest.raises(ValueError, match="at least one seed"):
        estimate([])


@pytest.mark.parametrize("seeds", [1, 2, 5, 10])
def test_the_smallest_p_is_that_of_one_sign_in_all_seeds(seeds: int) -> None:
    """Only all plus and all minus are as far from 0."""
    left = [1.0 + seed for seed in range(seeds)]
    assert paired_p(left, [0.0] * seeds) == pytest.approx(2 ** (1 - seeds))


def test_p_counts_the_sign_flips_that_are_as_extreme() -> None:
    """Differences 1, 2, -3: the sums of all flips are 0, 0, 2, -2, 4, -4, 6, -6, and this one is 0."""
    assert paired_p([1.0, 2.0, 0.0], [0.0, 0.0, 3.0]) == 1.0
    assert paired_p([1.0, 2.0, 3.0], [0.0, 0.0, 0.0]) == pytest.approx(2 / 8)
    assert paired_p([1.0, -2.0, 3.0], [0.0, 0.0, 0.0]) == pytest.approx(6 / 8)  # sum 2: all but the two zeros


def test_the_order_of_a_pair_does_not_matter() -> None:
    left, right = [0.3, 1.2, 0.9, 0.1], [0.5, 0.7, 0.2, 0.4]
    assert paired_p(left, right) == paired_p(right, left)


def test_many_seeds_draw_their_flips_from_a_seed() -> None:
    left = [float(seed % 5) for seed in range(EXACT + 4)]
    right = [float(seed % 3) for seed in range(EXACT + 4)]
    assert paired_p(left, right, seed=1) == paired_p(left, right, seed=1)
    assert 0.0 < paired_p(left, right) <= 1.0


def test_labels_are_interpolated_where_the_curve_first_comes_down() -> None:
    labels, losses = [200, 300, 400, 500], [4.0, 2.0, 3.0, 1.0]
    assert labels_to_reach(labels, losses, 3.0) == pytest.approx(250.0)
    assert labels_to_reach(labels, losses, 1.5) == pytest.approx(475.0)


def test_a_curve_that_begins_below_needs_no_more_and_one_that_stays_above_never_arrives() -> None:
    assert labels_to_reach([200, 300], [1.0, 2.0], 1.5) == 200.0
    assert labels_to_reach([200, 300], [4.0, 2.0], 1.5) is None
