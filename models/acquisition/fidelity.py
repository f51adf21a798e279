"""Fidelity (section 2.2): how far a prediction lies from anything that the subgoal generator thinks may come next."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import InferredActions, Models, given
from models.segments import SegmentBatch, at, first, future


@dataclass(frozen=True)
class Fidelity(InferredActions):
    """Distance from f(a^ | z_t) to the nearest of `samples` chains of p_phi(. | x_t)."""

    name: str = "fidelity"
    privileged: bool = False
    needs: frozenset[str] = frozenset({"world_model", "inverse_dynamics", "subgoal_generator"})
    samples: int = 8

    @torch.inference_mode()
    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in the world model's distance. The samples come from the generator."""
        world_model = given(self, "world_model", models.world_model)
        subgoals = given(self, "subgoal_generator", models.subgoal_generator)
        state = world_model.infer_state(first(batch.observations))
        prediction = world_model.rollout(state, self.actions(models, batch))
        now, nearest = at(batch.observations, 0), torch.full((batch.size,), torch.inf, device=state.device)
        for _ in range(self.samples):
            chain = subgoals.sample(now, batch.length, generator)
            nearest = torch.minimum(nearest, world_model.distance(prediction, future(chain)))
        return nearest
