"""Learning progress: how much better the world model has become at a segment since the round before."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import InferredActions, Models, given, labeled
from models.segments import SegmentBatch
from models.step_distances import nearest_true_actions, rollout_error


@dataclass(frozen=True)
class Progress(InferredActions):
    """L(theta_old) - L(theta_new) under inferred actions (delta-progress over one round, Kim et al. 2020).

    A project's first round has no older model: then it is the loss itself, as in the paper's code.
    """

    name: str = "progress"
    privileged: bool = False
    needs: frozenset[str] = frozenset({"world_model", "previous_world_model", "inverse_dynamics"})

    @torch.inference_mode()
    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in the world model's distance; below 0 where it has become worse. Draws nothing."""
        actions = self.actions(models, batch)
        now = rollout_error(given(self, "world_model", models.world_model), batch, actions)
        if models.previous_world_model is None:
            return now
        return rollout_error(models.previous_world_model, batch, actions) - now


@dataclass(frozen=True)
class TrueProgress(Progress):
    """The same under the true actions, as the paper's baseline has it: it has to know the labels beforehand."""

    name: str = "true_progress"
    privileged: bool = True
    needs: frozenset[str] = frozenset({"world_model", "previous_world_model"})

    def actions(self, models: Models, batch: SegmentBatch) -> Tensor:
        """The true ones, of several the one that the world model is best at now."""
        world_model = given(self, "world_model", models.world_model)
        return nearest_true_actions(world_model, labeled(self, batch))[0]

    @torch.inference_mode()
    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in true loss; below 0 where it has become worse. Draws nothing."""
        now = nearest_true_actions(given(self, "world_model", models.world_model), labeled(self, batch))[1]
        if models.previous_world_model is None:
            return now
        return nearest_true_actions(models.previous_world_model, batch)[1] - now
