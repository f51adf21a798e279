"""The world model as its own inverse: the control that asks what inverse dynamics adds at all."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import Models, given
from models.cycle_consistency import cycle_error
from models.segments import Observations, SegmentBatch, first, future
from models.spaces import DiscreteAction
from models.world_models.base import WorldModel


@dataclass(frozen=True)
class OwnInverse:
    """a_t = argmin_a l(x_{t+1}, f(z_t, a)): the action under which the world model finds the step likeliest.

    Raises ValueError for an action space that cannot be tried action by action.
    """

    world_model: WorldModel

    def infer(self, observations: Observations) -> Tensor:
        """(B, L+1, ...) -> (B, L), each step judged from its own observed x_t."""
        space = self.world_model.spaces.action
        if not isinstance(space, DiscreteAction):
            raise ValueError(f"The world model can be its own inverse where actions are discrete, not for {space}.")
        pairs = SegmentBatch(observations).transitions().observations  # (B*L, 2, ...)
        state, after = self.world_model.infer_state(first(pairs)), future(pairs)
        steps = len(state)
        errors = []
        for action in range(space.n):
            actions = torch.full((steps, 1), action, device=state.device)
            errors.append(self.world_model.distance(self.world_model.rollout(state, actions), after))
        return torch.stack(errors).argmin(0).view(-1, SegmentBatch(observations).length)


@dataclass(frozen=True)
class SelfInverse:
    """L_cyc under the world model's own inverse."""

    name: str = "self_inverse"
    privileged: bool = False
    needs: frozenset[str] = frozenset({"world_model"})

    def actions(self, models: Models, batch: SegmentBatch) -> Tensor:
        """Those that the world model finds likeliest."""
        return OwnInverse(given(self, "world_model", models.world_model)).infer(batch.observations)

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in the world model's distance. Draws nothing from the generator."""
        world_model = given(self, "world_model", models.world_model)
        return cycle_error(world_model, OwnInverse(world_model), batch.observations)
