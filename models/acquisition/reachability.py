"""Reachability (section 2.2): whether the action that was intended is what leads to the prediction."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import InferredActions, Models, given
from models.inverse_dynamics.base import ActionProbabilities, InverseDynamics
from models.segments import Observations, SegmentBatch, at, first
from models.world_models.base import WorldModel


@dataclass(frozen=True)
class Reachability(InferredActions):
    """-log h(a^ | x_t, x^_{t+1}), summed over steps: x^ is what the world model predicts of the inferred action.

    Of actions in a box it is |h(x_t, x^_{t+1}) - a^|^2.
    """

    name: str = "reachability"
    privileged: bool = False
    needs: frozenset[str] = frozenset({"world_model", "inverse_dynamics"})

    @torch.inference_mode()
    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) nats, or squares of an action's numbers. Draws nothing from the generator."""
        world_model = given(self, "world_model", models.world_model)
        inverse = given(self, "inverse_dynamics", models.inverse_dynamics)
        return unreachability(world_model, inverse, batch.observations, self.actions(models, batch))


def unreachability(
    world_model: WorldModel, inverse: InverseDynamics, observations: Observations, actions: Tensor
) -> Tensor:
    """How little the inverse dynamics recognises actions (B, L) in what the world model says they lead to -> (B,)."""
    chain = predicted_chain(world_model, observations, actions)
    if not isinstance(inverse, ActionProbabilities):
        return (inverse.infer(chain) - actions).square().sum((1, 2))
    log_prob = inverse.log_prob(SegmentBatch(chain))  # (B, L, n)
    return -log_prob.gather(-1, actions.unsqueeze(-1)).squeeze(-1).sum(1)


def predicted_chain(world_model: WorldModel, observations: Observations, actions: Tensor) -> Observations:
    """x_t and the likeliest observation of each predicted state: (B, 1+, ...), (B, L) -> (B, L+1, ...)."""
    prediction = world_model.rollout(world_model.infer_state(first(observations)), actions)
    seen = world_model.observe(prediction.flatten(0, 1))  # (B, L, ...) -> (B*L, ...)
    batch, steps = actions.shape[:2]
    now = at(observations, 0)
    return {
        name: torch.cat((now[name].unsqueeze(1), stream.view(batch, steps, *stream.shape[1:])), 1)
        for name, stream in seen.items()
    }
