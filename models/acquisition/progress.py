"""Learning progress: how much better the world model has become at a segment since the round before."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import Models, given, labels
from models.segments import SegmentBatch, first, future
from models.world_models.base import WorldModel


@dataclass(frozen=True)
class Progress:
    """L(theta_old) - L(theta_new) under inferred actions (delta-progress over one round, Kim et al. 2020).

    A project's first round has no older model: then it is the loss itself, as in the paper's code.
    """

    name: str = "progress"
    privileged: bool = False
    needs: frozenset[str] = frozenset({"world_model", "previous_world_model", "inverse_dynamics"})

    def actions(self, models: Models, batch: SegmentBatch) -> Tensor:
        """The inferred ones."""
        return given(self, "inverse_dynamics", models.inverse_dynamics).infer(batch.observations)

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
        """The true ones."""
        return labels(self, batch)


def rollout_error(world_model: WorldModel, batch: SegmentBatch, actions: Tensor) -> Tensor:
    """l(x_{t+1:t+L}, f(a | z_t)) of segments under actions (B, L) -> (B,)."""
    prediction = world_model.rollout(world_model.infer_state(first(batch.observations)), actions)
    return world_model.distance(prediction, future(batch.observations))
