"""The cycle with confidence filtering (section 3.1): what the inverse dynamics doubts ranks lower."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import Models, given
from models.cycle_consistency import cycle
from models.inverse_dynamics.base import ActionProbabilities
from models.segments import SegmentBatch
from models.step_distances import nearest_actions


@dataclass(frozen=True)
class ConfidentCycle:
    """sum_i min_a l(x_{i+1}, f(z^_i, a)) over the actions with confidence h(a | x_i, x_{i+1}) >= least.

    One action is left where the inverse dynamics is sure, and this is L_cyc. Where it doubts, a distance counts as the
    world model's error only if no plausible action explains the step: the likeliest one alone may be the inverse
    dynamics' mistake. Inverse dynamics that says no probabilities, over a box, leaves one action too: its own.
    """

    name: str = "confident_cycle"
    privileged: bool = False
    needs: frozenset[str] = frozenset({"world_model", "inverse_dynamics"})
    least: float = 1e-3

    def actions(self, models: Models, batch: SegmentBatch) -> Tensor:
        """Of the plausible ones those under which the world model is nearest to what came next."""
        return self._nearest(models, batch)[0]

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in the world model's distance. Draws nothing from the generator."""
        return self._nearest(models, batch)[1]

    @torch.inference_mode()
    def _nearest(self, models: Models, batch: SegmentBatch) -> tuple[Tensor, Tensor]:
        """Actions (B, L) and score (B,)."""
        world_model = given(self, "world_model", models.world_model)
        inverse = given(self, "inverse_dynamics", models.inverse_dynamics)
        if not isinstance(inverse, ActionProbabilities):
            return cycle(world_model, inverse, batch.observations)
        confidence = inverse.log_prob(batch)  # (B, L, n)
        plausible = (confidence >= math.log(self.least)) | (confidence == confidence.amax(-1, keepdim=True))
        return nearest_actions(world_model, batch.observations, plausible)
