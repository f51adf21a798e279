"""Oracle turned round: the segments that the world model predicts best already."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import Models
from models.acquisition.oracle import Oracle
from models.segments import SegmentBatch


@dataclass(frozen=True)
class OracleEasy(Oracle):
    """exp(-true loss): what choosing by loss costs when the sign is wrong."""

    name: str = "oracle_easy"

    @torch.inference_mode()
    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in (0, 1], in double precision: a loss above 100 still has a place of its own. Draws nothing."""
        return super().score(models, batch, generator).double().neg().exp()
