"""A world model's distance from what came next under each of several actions, one step at a time."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.segments import Observations, SegmentBatch, first, future
from models.spaces import DiscreteAction
from models.world_models.base import WorldModel


@dataclass(frozen=True)
class StepDistances:
    """table (B, n): l(x_{t+1}, f(z_t, a)), infinite for actions that were not asked for."""

    table: Tensor
    predictions: Tensor  # (P, ...), of all pairs of a segment and an action that was asked for
    places: Tensor  # int64 (B, n): where a pair's prediction is

    def state(self, actions: Tensor) -> Tensor:
        """Predicted states (B, ...) under actions (B,) that were asked for."""
        return self.predictions[self.places.gather(1, actions.unsqueeze(1)).squeeze(1)]


def step_distances(
    world_model: WorldModel, state: Tensor, asked: Tensor, observations: Observations, step: int
) -> StepDistances:
    """From states (B, ...) at `step` of segments (B, L+1, ...), under the actions in `asked` bool (B, n)."""
    rows, actions = asked.nonzero(as_tuple=True)  # (P,)
    prediction = world_model.rollout(state[rows], actions.unsqueeze(1))  # (P, 1, ...)
    after = {name: stream[rows, step + 1].unsqueeze(1) for name, stream in observations.items()}
    distance = world_model.distance(prediction, after)
    table = distance.new_full(asked.shape, torch.inf)
    table[rows, actions] = distance
    places = (asked.flatten().cumsum(0) - 1).view_as(asked)
    return StepDistances(table, prediction[:, 0], places)


def nearest_actions(world_model: WorldModel, observations: Observations, asked: Tensor) -> tuple[Tensor, Tensor]:
    """Of the actions asked for, bool (B, L, n), those the world model is best at: (B, L), and its distance (B,).

    Of longer segments each step's action is chosen before the next is predicted, which for L = 1 is the minimum itself.
    """
    state, total, actions = (
        world_model.infer_state(first(observations)),
        torch.zeros(len(asked), device=asked.device),
        [],
    )
    for step in range(asked.shape[1]):
        distances = step_distances(world_model, state, asked[:, step], observations, step)
        nearest, action = distances.table.min(1)
        state, total = distances.state(action), total + nearest
        actions.append(action)
    return torch.stack(actions, 1), total


def rollout_error(world_model: WorldModel, batch: SegmentBatch, actions: Tensor) -> Tensor:
    """l(x_{t+1:t+L}, f(a | z_t)) of segments under actions (B, L) -> (B,)."""
    prediction = world_model.rollout(world_model.infer_state(first(batch.observations)), actions)
    return world_model.distance(prediction, future(batch.observations))


def nearest_true_actions(world_model: WorldModel, batch: SegmentBatch) -> tuple[Tensor, Tensor]:
    """Of the actions that explain each step, those the world model is best at, (B, L), and its true loss (B,).

    All actions in the set of a step are true, so the world model errs by its smallest distance over them. Continuous
    actions have no sets. Raises ValueError for a batch without actions.
    """
    space = world_model.spaces.action
    if isinstance(space, DiscreteAction):
        return nearest_actions(world_model, batch.observations, batch.explanations(space.n))
    if batch.actions is None:
        raise ValueError("The true loss needs labeled segments; the batch carries no actions.")
    return batch.actions, rollout_error(world_model, batch, batch.actions)
