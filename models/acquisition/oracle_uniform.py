"""Oracle spread out: as many easy segments as hard ones."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.oracle import Oracle

INTERVALS = 10
FLOOR = 1e-4  # nats; losses below it are as good as none


@dataclass(frozen=True)
class OracleUniform(Oracle):
    """One segment from each of ten equal intervals of the true loss's logarithm, by turns, at random within one."""

    name: str = "oracle_uniform"

    def over_pool(self, scores: Tensor, generator: torch.Generator) -> Tensor:
        """Losses (N,) -> scores (N,) in (0, 1]: their order is the order by turns."""
        if len(scores) == 0:
            return scores
        shuffled = torch.randperm(len(scores), generator=generator)
        interval = _interval(scores.double())[shuffled]
        by_interval = torch.sort(interval, stable=True)
        begins = torch.searchsorted(by_interval.values, by_interval.values)  # where each one's interval begins
        turn = torch.empty_like(interval)
        turn[by_interval.indices] = torch.arange(len(interval)) - begins
        # Within a turn the hardest interval comes first.
        order = shuffled[torch.argsort(turn * INTERVALS + (INTERVALS - 1 - interval), stable=True)]
        ranked = torch.empty(len(scores), dtype=torch.float64)
        ranked[order] = torch.arange(len(scores), 0, -1, dtype=torch.float64) / len(scores)
        return ranked


def _interval(losses: Tensor) -> Tensor:
    """int64 (N,) from 0 to INTERVALS - 1."""
    logarithm = losses.clamp(min=FLOOR).log()
    low, high = float(logarithm.min()), float(logarithm.max())
    width = max((high - low) / INTERVALS, math.ulp(1.0))
    return ((logarithm - low) / width).long().clamp(0, INTERVALS - 1)
