"""Signature deduplication: no event twice before every event is in once."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.batch_rules.base import Candidates, Description, top


@dataclass(frozen=True)
class Signatures:
    """Goes round the signatures by their best score: first the best candidate of each, then the second best."""

    name: str = "signatures"
    reads: Description = "signatures"

    def order(self, candidates: Candidates, count: int, generator: torch.Generator) -> Tensor:
        """Draws nothing from the generator. Without signatures it is the plain order by score."""
        ranking = top(candidates.scores, candidates.count)
        if candidates.signatures is None:
            return ranking[:count]
        _, group = torch.unique(candidates.signatures[ranking], dim=0, return_inverse=True)
        by_group = torch.sort(group, stable=True)  # within a group still best first
        begins = torch.searchsorted(by_group.values, by_group.values)
        turn = torch.empty_like(group)
        turn[by_group.indices] = torch.arange(len(group)) - begins
        return ranking[torch.argsort(turn, stable=True)][:count]
