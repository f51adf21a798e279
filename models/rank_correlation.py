"""Rank correlation of two measurements of the same N things: Spearman's rho and Kendall's tau-b, both with ties.

Kendall, M. G. (1945), The treatment of ties in ranking problems. Discordant pairs are counted as inversions while the
values are merge-sorted (Knight 1966): O(N log^2 N) time and O(N) memory, so there is no table of all pairs.
"""

import math

import torch
from torch import Tensor


def spearman(left: Tensor, right: Tensor) -> float | None:
    """Pearson's correlation of the average ranks of left (N,) and right (N,), in [-1, 1].

    None where it is not defined: fewer than two values, or all equal on one side. Raises ValueError for shapes that
    disagree and for values that are not finite.
    """
    _check(left, right)
    x, y = average_ranks(left), average_ranks(right)
    x, y = x - x.mean(), y - y.mean()
    scale = float(x.square().sum() * y.square().sum())
    return float((x * y).sum()) / math.sqrt(scale) if scale > 0.0 else None


def kendall(left: Tensor, right: Tensor) -> float | None:
    """tau-b = (concordant - discordant) / sqrt((pairs - ties of left) (pairs - ties of right)), in [-1, 1].

    None and ValueError as in `spearman`.
    """
    _check(left, right)
    (x, _), (y, _) = _dense_ranks(left), _dense_ranks(right)
    both = x * (len(y) + 1) + y  # orders by left, and by right where left is tied
    pairs, tied_x, tied_y, tied = math.comb(len(x), 2), _tied_pairs(x), _tied_pairs(y), _tied_pairs(both)
    discordant = _inversions(y[both.argsort()])
    scale = (pairs - tied_x) * (pairs - tied_y)
    return (pairs - tied_x - tied_y + tied - 2 * discordant) / math.sqrt(scale) if scale > 0 else None


def average_ranks(values: Tensor) -> Tensor:
    """Ranks from 1, equal values share the mean of theirs: (N,) -> float64 (N,)."""
    dense, counts = _dense_ranks(values)
    last = counts.cumsum(0).double()
    return (last - (counts - 1) / 2)[dense]


def _dense_ranks(values: Tensor) -> tuple[Tensor, Tensor]:
    """Ranks from 0 without gaps, int64 (N,), and how often each occurs."""
    _, ranks, counts = torch.unique(values, return_inverse=True, return_counts=True)
    return ranks, counts


def _tied_pairs(ranks: Tensor) -> int:
    counts = _dense_ranks(ranks)[1]
    return int((counts * (counts - 1) // 2).sum())


def _inversions(ranks: Tensor) -> int:
    """Pairs i < j with ranks[i] > ranks[j]: counted between the sorted halves of ever larger blocks. int64 (N,)."""
    size = 1 << max(0, len(ranks) - 1).bit_length()
    padded = torch.full((size,), len(ranks), dtype=torch.int64, device=ranks.device)  # above all ranks, and behind them
    padded[: len(ranks)] = ranks
    blocks, count = padded.unsqueeze(1), 0
    while len(blocks) > 1:
        left, right = blocks[::2].contiguous(), blocks[1::2].contiguous()
        count += int(torch.searchsorted(right, left).sum())  # of each on the left, how many on the right are smaller
        blocks = torch.cat((left, right), 1).sort(1).values
    return count


def _check(left: Tensor, right: Tensor) -> None:
    if left.dim() != 1 or left.shape != right.shape:
        raise ValueError(f"left and right must be (N,) alike, got {tuple(left.shape)} and {tuple(right.shape)}.")
    for name, values in (("left", left), ("right", right)):
        if not bool(torch.isfinite(values).all()):
            bad = int((~torch.isfinite(values)).nonzero()[0])
            raise ValueError(f"{name} must be finite to be ranked, got {float(values[bad])} at {bad}.")
