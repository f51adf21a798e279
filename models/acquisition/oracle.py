"""Oracle: the true loss, which only who knows the labels can compute."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import Models, given, labeled
from models.segments import SegmentBatch
from models.step_distances import nearest_true_actions


@dataclass(frozen=True)
class Oracle:
    """The world model's loss under the true actions, of those that explain a step the one it is best at: hardest first.

    Under one of them drawn by chance, as a label is, a step that two actions explain would count as an error of a world
    model that knows only one of them, although nothing it predicts of that one is wrong.
    """

    name: str = "oracle"
    privileged: bool = True
    needs: frozenset[str] = frozenset({"world_model"})

    def actions(self, models: Models, batch: SegmentBatch) -> Tensor:
        """The true ones, of several the one that counts."""
        return self._nearest(models, batch)[0]

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in the world model's distance. Draws nothing from the generator."""
        return self._nearest(models, batch)[1]

    @torch.inference_mode()
    def _nearest(self, models: Models, batch: SegmentBatch) -> tuple[Tensor, Tensor]:
        """Actions (B, L) and true loss (B,)."""
        return nearest_true_actions(given(self, "world_model", models.world_model), labeled(self, batch))
