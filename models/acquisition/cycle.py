"""The method: cycle error of the observed future under the sparse inverse dynamics."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import Models
from models.cycle_consistency import cycle_error
from models.segments import SegmentBatch


@dataclass(frozen=True)
class Cycle:
    """L_cyc of a segment with its own observed future as the chain."""

    name: str = "cycle"
    privileged: bool = False
    needs: frozenset[str] = frozenset({"world_model", "inverse_dynamics"})

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in the world model's distance. Draws nothing from the generator."""
        if models.world_model is None or models.inverse_dynamics is None:
            raise ValueError("Strategy cycle needs a world_model and inverse_dynamics.")
        return cycle_error(models.world_model, models.inverse_dynamics, batch.observations)
