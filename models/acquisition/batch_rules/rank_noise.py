"""Stochastic rank noise (softrank of Kirsch et al. 2023, arXiv 2106.12059): a batch drawn by rank."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.batch_rules.base import Candidates, top
from models.networks.initialisation import gumbel


@dataclass(frozen=True)
class RankNoise:
    """Orders by -log(rank) + Gumbel / beta, which draws without replacement with probability ~ rank^-beta."""

    name: str = "rank_noise"
    reads: None = None
    beta: float = 1.0

    def order(self, candidates: Candidates, count: int, generator: torch.Generator) -> Tensor:
        """Ranks count from 1."""
        ranking = top(candidates.scores, candidates.count)
        rank = torch.arange(1, candidates.count + 1, dtype=torch.float64)
        noise = gumbel(rank.shape, generator, rank.device) / self.beta
        return ranking[top(noise - rank.log(), count)]
