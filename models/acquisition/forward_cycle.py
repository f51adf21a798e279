"""The forward-first cycle (section 2.3's strawman): act, predict, and see whether the action can be recovered."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import InferredActions, Models, given
from models.acquisition.reachability import unreachability
from models.segments import SegmentBatch, first
from models.spaces import DiscreteAction


@dataclass(frozen=True)
class ForwardCycle(InferredActions):
    """Mean over actions of -log h(a | x_t, x^_{t+1}), x^ the prediction of f(z_t, a).

    It looks at x_t alone and rolls out one step under every action, which for a discrete space is what sampling many
    comes to. Raises ValueError for a continuous one.
    """

    name: str = "forward_cycle"
    privileged: bool = False
    needs: frozenset[str] = frozenset({"world_model", "inverse_dynamics"})

    @torch.inference_mode()
    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) nats. Draws nothing from the generator."""
        world_model = given(self, "world_model", models.world_model)
        inverse = given(self, "inverse_dynamics", models.inverse_dynamics)
        space = world_model.spaces.action
        if not isinstance(space, DiscreteAction):
            raise ValueError(f"Strategy forward_cycle tries every action, which {space} has too many of.")
        now = first(batch.observations)
        device = next(iter(now.values())).device
        errors = [
            unreachability(world_model, inverse, now, torch.full((batch.size, 1), action, device=device))
            for action in range(space.n)
        ]
        return torch.stack(errors).mean(0)
