"""Disagreement of an ensemble of world models under the inferred action."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import InferredActions, Models
from models.segments import Observations, SegmentBatch, first
from models.world_models.base import WorldModel


@dataclass(frozen=True)
class Uncertainty(InferredActions):
    """A true ensemble: members differ in their initialisation and minibatches. The score never sees x_{t+1} itself."""

    name: str = "uncertainty"
    privileged: bool = False
    needs: frozenset[str] = frozenset({"inverse_dynamics", "ensemble"})

    @torch.inference_mode()
    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,): mutual information of member and prediction (grid), summed over steps. Draws nothing."""
        if len(models.ensemble) < 2:
            raise ValueError(f"Strategy uncertainty needs an ensemble of at least 2, got {len(models.ensemble)}.")
        actions = self.actions(models, batch)
        decoded = [_decoded(member, batch.observations, actions) for member in models.ensemble]
        return models.ensemble[0].disagreement(decoded).view(batch.size, batch.length).sum(1)


def _decoded(member: WorldModel, observations: Observations, actions: Tensor) -> Observations:
    prediction = member.rollout(member.infer_state(first(observations)), actions)
    return member.decode(prediction.flatten(0, 1))  # (B, L, ...) -> (B*L, ...)
