"""Model error: how well a world model predicts labeled segments and inverse dynamics recovers their actions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from models.inverse_dynamics.base import InverseDynamics
from models.open_loop import OpenLoopError, open_loop
from models.segments import Observations, SegmentBatch, at, first, future
from models.spaces import BoxAction
from models.world_models.base import WorldModel

NEAR = 0.1  # of a box's range


@dataclass(frozen=True)
class GroupError:
    """Error over some transitions; None where there is nothing to average over.

    next_state_loss: distance of one-step predictions, mean over transitions (grid: nats summed over the observation).
    dynamics_accuracy: changed elements predicted right / changed elements, pooled over transitions.
    exact_accuracy: share of transitions whose likeliest prediction is the whole next observation; None where
    observations are no symbols, which nothing predicts exactly.
    inverse_accuracy: share of transitions whose inferred action is in the label's action set; of actions in a box the
    share of their numbers that are at most a tenth of the box away from the label's.
    """

    transitions: int
    next_state_loss: float | None
    exact_accuracy: float | None
    dynamics_accuracy: float | None
    inverse_accuracy: float | None


@dataclass(frozen=True)
class ModelError:
    """Error over all transitions, and over those whose labeled action is in a group.

    open_loop: over whole segments, of models that are not symbolic.
    """

    overall: GroupError
    groups: dict[str, GroupError]
    open_loop: tuple[OpenLoopError, ...] = ()

    @property
    def loss(self) -> float | None:
        """What compares between models: the next-state loss of symbols, else what of whole segments is not foreseen."""
        return self.open_loop[-1].unforeseen if self.open_loop else self.overall.next_state_loss


@dataclass(frozen=True)
class TransitionErrors:
    """Per transition (N,): distance, whole next observation predicted right (of symbols), changed elements predicted
    right, changed elements, inferred action right, or how much of it."""

    distance: Tensor
    exact: Tensor | None
    correct: Tensor
    changed: Tensor
    inverse_correct: Tensor | None

    def group(self, members: Tensor) -> GroupError:
        """The error of the transitions where `members` (N,) is true."""
        count = int(members.sum())
        changed = int(self.changed[members].sum())
        return GroupError(
            transitions=count,
            next_state_loss=float(self.distance[members].double().mean()) if count else None,
            exact_accuracy=_mean(self.exact, members),
            dynamics_accuracy=int(self.correct[members].sum()) / changed if changed else None,
            inverse_accuracy=_mean(self.inverse_correct, members),
        )


def evaluate(
    world_model: WorldModel,
    batch: SegmentBatch,
    groups: Mapping[str, set[int]],
    inverse_dynamics: InverseDynamics | None = None,
    chunk: int = 512,
    after_each: Callable[[], None] = lambda: None,
) -> ModelError:
    """One-step errors over all transitions of labeled segments (on the models' device), and open-loop errors over
    whole ones where observations are no symbols.

    groups: name -> discrete actions, e.g. {"movement": {0, 1, 2}}. after_each: called after each chunk; may raise to
    stop. Raises ValueError for a batch without actions.
    """
    if batch.actions is None:
        raise ValueError("Evaluation needs labeled segments; the batch carries no actions.")
    errors = transition_errors(world_model, batch, inverse_dynamics, chunk, after_each)
    actions = batch.transitions().actions
    everything = torch.ones(len(errors.distance), dtype=torch.bool, device=errors.distance.device)
    return ModelError(
        overall=errors.group(everything),
        groups={name: errors.group(_in(actions, members)) for name, members in groups.items()},
        open_loop=() if world_model.symbolic else open_loop(world_model, batch, after_each),
    )


@torch.inference_mode()
def transition_errors(
    world_model: WorldModel,
    batch: SegmentBatch,
    inverse_dynamics: InverseDynamics | None = None,
    chunk: int = 512,
    after_each: Callable[[], None] = lambda: None,
) -> TransitionErrors:
    """The parts of the model error of every transition, in the order of `batch.transitions()`."""
    parts, segments = list[TransitionErrors](), max(1, chunk // batch.length)
    for start in range(0, batch.size, segments):
        parts.append(_errors(world_model, batch.take(slice(start, start + segments)), inverse_dynamics))
        after_each()
    exact = [part.exact for part in parts if part.exact is not None]
    inverse = [part.inverse_correct for part in parts if part.inverse_correct is not None]
    return TransitionErrors(
        distance=torch.cat([part.distance for part in parts]),
        exact=torch.cat(exact) if exact else None,
        correct=torch.cat([part.correct for part in parts]),
        changed=torch.cat([part.changed for part in parts]),
        inverse_correct=torch.cat(inverse) if inverse else None,
    )


def _errors(world_model: WorldModel, batch: SegmentBatch, inverse_dynamics: InverseDynamics | None) -> TransitionErrors:
    pairs = batch.transitions()
    actions: Any = pairs.actions
    prediction = world_model.rollout(world_model.infer_state(first(pairs.observations)), actions)
    correct, changed = world_model.changes(prediction[:, 0], pairs.observations)
    return TransitionErrors(
        distance=world_model.distance(prediction, future(pairs.observations)),
        exact=_equal(world_model.observe(prediction[:, 0]), at(pairs.observations, 1))
        if world_model.symbolic
        else None,
        correct=correct,
        changed=changed,
        inverse_correct=None if inverse_dynamics is None else recovered(inverse_dynamics, batch).flatten(),
    )


def _equal(left: Observations, right: Observations) -> Tensor:
    """Whether whole observations (N, ...) are equal -> bool (N,)."""
    return torch.stack([(left[name] == right[name]).flatten(1).all(1) for name in right]).all(0)


def recovered(inverse_dynamics: InverseDynamics, batch: SegmentBatch, inferred: Tensor | None = None) -> Tensor:
    """Of each step of labeled segments, whether the inferred action is among those that explain it: (B, L).

    Of actions in a box: which share of their numbers is at most a tenth of the box away. inferred: where it is known.
    """
    inferred = inverse_dynamics.infer(batch.observations) if inferred is None else inferred
    if batch.action_sets is not None:
        return batch.action_sets.gather(2, inferred.unsqueeze(2)).squeeze(2)
    actions: Any = batch.actions
    space = inverse_dynamics.spaces.action
    if isinstance(space, BoxAction):
        near = (inferred - actions).abs() <= NEAR * (space.high - space.low)
        share: Tensor = near.flatten(2).float().mean(2)
        return share
    return torch.eq(inferred, actions)


def _mean(values: Tensor | None, members: Tensor) -> float | None:
    """Over the members, None where there is nothing to average over."""
    return float(values[members].double().mean()) if values is not None and bool(members.any()) else None


def _in(actions: Tensor | None, members: set[int]) -> Tensor:
    assert actions is not None  # noqa: S101  # evaluate refuses a batch without actions
    return torch.isin(actions[:, 0], torch.tensor(sorted(members), device=actions.device))
