"""Top-n: the plain order by score, as the paper has it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.batch_rules.base import Candidates, top


@dataclass(frozen=True)
class Top:
    """The highest scores first, whatever they have in common."""

    name: str = "top"
    reads: None = None

    def order(self, candidates: Candidates, count: int, generator: torch.Generator) -> Tensor:
        """Draws nothing from the generator."""
        return top(candidates.scores, count)
