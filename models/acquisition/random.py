"""Uniform random scores: the baseline of every comparison."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import Models
from models.segments import SegmentBatch


@dataclass(frozen=True)
class Random:
    """Uniform on [0, 1)."""

    name: str = "random"
    privileged: bool = False
    needs: frozenset[str] = frozenset()

    def actions(self, models: Models, batch: SegmentBatch) -> None:
        """None: it looks at nothing, so every batch rule leaves its order alone."""

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,), on the generator's device."""
        return torch.rand(batch.size, generator=generator, device=generator.device)
