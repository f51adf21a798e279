"""What every subgoal generator offers."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from models.network import Network
from models.segments import Observations, SegmentBatch


class Futures(NamedTuple):
    """M different chains, several of them from each of B states.

    chains: streams (M, K+1, ...). states int64 (M,): the row of the state that each begins at. log_prob (M,): nats, up
    to a constant. steady bool (M,): those that the generator stands by.
    """

    chains: Observations
    states: Tensor
    log_prob: Tensor
    steady: Tensor


class SubgoalGenerator(Network, Protocol):
    """p_phi(x_{t+1:t+K} | x_t), trained on action-free data only: the loss refuses a batch that carries actions."""

    def sample(self, observations: Observations, horizon: int, generator: torch.Generator) -> Observations:
        """Equation 4: observations x_t (B, ...) -> one chain each (B, K+1, ...), whose first element is x_t."""
        ...

    def futures(self, observations: Observations, horizon: int, generator: torch.Generator) -> Futures:
        """What may follow x_t (B, ...) in K steps, the rare with the usual; that nothing happens is always among it.

        Samples show what is usual. What is worth executing is rare.
        """
        ...


def refuse_actions(batch: SegmentBatch) -> None:
    """Raises ValueError for a batch that carries actions."""
    if batch.actions is not None or batch.action_sets is not None:
        raise ValueError("A subgoal generator never sees actions, but the batch carries them; use without_labels().")


def with_idle(observations: Observations, chain: Sequence[Observations], found: Futures, log_prob: float) -> Futures:
    """The futures with their chains, and of each state one more in which nothing happens."""
    count = len(next(iter(observations.values())))
    still = {name: torch.stack([stream] * len(chain), 1) for name, stream in observations.items()}
    chains = {name: torch.cat((torch.stack([step[name] for step in chain], 1), still[name])) for name in still}
    every = torch.arange(count, device=found.states.device)
    return Futures(
        chains,
        torch.cat((found.states, every)),
        torch.cat((found.log_prob, found.log_prob.new_full((count,), log_prob))),
        torch.cat((found.steady, torch.zeros_like(every, dtype=torch.bool))),
    )
