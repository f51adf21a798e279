"""Cycle consistency (equations 4-7) and Algorithm 1, for any family."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.inverse_dynamics.base import ActionInference
from models.segments import Observations, first, future
from models.subgoal_generators.base import SubgoalGenerator
from models.world_models.base import WorldModel


@dataclass(frozen=True)
class WorstChain:
    """Per state, the chain with the largest cycle error.

    actions (B, K) or (B, K, D): inferred along it, to be executed. error (B,). chain: stream -> (B, K+1, ...).
    """

    actions: Tensor
    error: Tensor
    chain: Observations


@torch.inference_mode()  # scores are compared, never differentiated
def cycle(world_model: WorldModel, inverse_dynamics: ActionInference, chain: Observations) -> tuple[Tensor, Tensor]:
    """Inferred actions (B, K) and cycle error (B,) of chains (B, K+1, ...), observed or generated."""
    actions = inverse_dynamics.infer(chain)  # (5)
    state = world_model.infer_state(first(chain))
    prediction = world_model.rollout(state, actions)  # (6)
    return actions, world_model.distance(prediction, future(chain))  # (7)


def cycle_error(world_model: WorldModel, inverse_dynamics: ActionInference, chain: Observations) -> Tensor:
    """L_cyc = sum_i l(z~_{t+i}, z^_{t+i}) of each chain (B, K+1, ...) -> (B,)."""
    return cycle(world_model, inverse_dynamics, chain)[1]


def worst_chain(
    world_model: WorldModel,
    inverse_dynamics: ActionInference,
    subgoal_generator: SubgoalGenerator,
    observations: Observations,
    chains: int,
    horizon: int,
    generator: torch.Generator,
) -> WorstChain:
    """Algorithm 1 at states x_t (B, ...): of N sampled chains of K steps, the one with the largest cycle error.

    Raises ValueError when `chains` or `horizon` is below 1.
    """
    if chains < 1 or horizon < 1:
        raise ValueError(f"chains and horizon must be at least 1, got {chains} and {horizon}.")
    worst = _sampled(world_model, inverse_dynamics, subgoal_generator, observations, horizon, generator)
    for _ in range(chains - 1):
        rival = _sampled(world_model, inverse_dynamics, subgoal_generator, observations, horizon, generator)
        worst = _worse(worst, rival)
    return worst


def _sampled(
    world_model: WorldModel,
    inverse_dynamics: ActionInference,
    subgoal_generator: SubgoalGenerator,
    observations: Observations,
    horizon: int,
    generator: torch.Generator,
) -> WorstChain:
    chain = subgoal_generator.sample(observations, horizon, generator)  # (4)
    actions, error = cycle(world_model, inverse_dynamics, chain)
    return WorstChain(actions, error, chain)


def _worse(left: WorstChain, right: WorstChain) -> WorstChain:
    wins = right.error > left.error
    chain = {name: _select(wins, right.chain[name], left.chain[name]) for name in left.chain}
    return WorstChain(_select(wins, right.actions, left.actions), torch.maximum(left.error, right.error), chain)


def _select(wins: Tensor, right: Tensor, left: Tensor) -> Tensor:
    return torch.where(wins.view(-1, *(1,) * (left.dim() - 1)), right, left)
