"""The cycle with dense inverse dynamics: what the mask M is worth."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import Models
from models.cycle_consistency import cycle_error
from models.segments import SegmentBatch


@dataclass(frozen=True)
class VanillaCycle:
    """L_cyc under the dense inverse dynamics."""

    name: str = "vanilla_cycle"
    privileged: bool = False
    needs: frozenset[str] = frozenset({"world_model", "dense_inverse_dynamics"})

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in the world model's distance. Draws nothing from the generator."""
        if models.world_model is None or models.dense_inverse_dynamics is None:
            raise ValueError("Strategy vanilla_cycle needs a world_model and dense_inverse_dynamics.")
        return cycle_error(models.world_model, models.dense_inverse_dynamics, batch.observations)
