"""Means with confidence intervals, paired tests and labels saved, over the seeds of a benchmark."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 10_000
EXACT = 12  # seeds up to which all sign flips are tried


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds and its 95 % confidence interval, by Student's t."""

    mean: float
    half_width: float

    def __str__(self) -> str:
        return f"{self.mean:.3g} ± {self.half_width:.2g}"


# Two-sided 97.5 % quantiles of Student's t for 1 to 30 degrees of freedom.
T = (
    *(12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131),
    *(2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042),
)


def estimate(values: Sequence[float]) -> Estimate:
    """Of one value a seed; a single seed has an infinite interval. Raises ValueError for none."""
    if not len(values):
        raise ValueError("An estimate needs at least one seed, got none.")
    sample = np.asarray(values, np.float64)
    if len(sample) == 1:
        return Estimate(float(sample[0]), float("inf"))
    quantile = T[min(len(sample) - 1, len(T)) - 1]
    return Estimate(float(sample.mean()), float(quantile * sample.std(ddof=1) / np.sqrt(len(sample))))


def paired_p(left: Sequence[float], right: Sequence[float], seed: int = 0) -> float:
    """Two-sided p of the sign-flip test that left - right, paired by seed, has mean 0.

    Exact up to EXACT seeds, else by random flips. With n seeds no p is below 2^(1-n).
    """
    difference = np.asarray(left, np.float64) - np.asarray(right, np.float64)
    signs = _signs(len(difference), seed)
    means = np.abs(signs @ difference)
    return float(np.mean(means >= abs(difference.sum()) * (1 - 1e-12)))


def labels_to_reach(labels: Sequence[int], losses: Sequence[float], target: float) -> float | None:
    """Where the curve first comes down to `target`, by linear interpolation; None where it does not."""
    if losses[0] <= target:
        return float(labels[0])
    for before, after, high, low in zip(labels, labels[1:], losses, losses[1:], strict=False):
        if low <= target:
            return before + (after - before) * (high - target) / (high - low)
    return None


def _signs(count: int, seed: int) -> NDArray[np.float64]:
    if count <= EXACT:
        return np.array(list(itertools.product((-1.0, 1.0), repeat=count)))
    return np.random.default_rng(seed).choice((-1.0, 1.0), (RESAMPLES, count))
