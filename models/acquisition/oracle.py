"""Oracle: the true loss, which only who knows the labels can compute."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import Models, given, labels
from models.acquisition.progress import rollout_error
from models.segments import SegmentBatch


@dataclass(frozen=True)
class Oracle:
    """The world model's loss under the true actions: the hardest segments first."""

    name: str = "oracle"
    privileged: bool = True
    needs: frozenset[str] = frozenset({"world_model"})

    def actions(self, models: Models, batch: SegmentBatch) -> Tensor:
        """The true ones."""
        return labels(self, batch)

    @torch.inference_mode()
    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in the world model's distance. Draws nothing from the generator."""
        return rollout_error(given(self, "world_model", models.world_model), batch, labels(self, batch))
