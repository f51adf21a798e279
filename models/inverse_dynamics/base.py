"""What every inverse dynamics model offers, and the likelihood of a label that is a set of actions."""

from typing import Protocol

import torch
from torch import Tensor

from models.network import Network
from models.segments import Observations, SegmentBatch


class InverseDynamics(Network, Protocol):
    """h_psi: the action between two observations. The loss raises ValueError for a batch without actions."""

    def infer(self, observations: Observations) -> Tensor:
        """Equation 5: observations (B, L+1, ...) -> actions (B, L) or (B, L, D)."""
        ...


class DiscreteInverseDynamics(InverseDynamics, Protocol):
    """Inverse dynamics over a finite set of actions."""

    def log_prob(self, batch: SegmentBatch) -> Tensor:
        """log p(a | x_t, x_{t+1}) for every action -> (B, L, n)."""
        ...


def negative_log_likelihood(log_prob: Tensor, batch: SegmentBatch) -> Tensor:
    """-log of the summed probability of the label's action set where given, else of its action: (B, L, n) -> (B, L).

    Raises ValueError for a batch that carries neither, or an empty set.
    """
    if batch.action_sets is not None:
        if not bool(batch.action_sets.any(-1).all()):
            raise ValueError("action_sets holds an empty set: no action explains one of the steps.")
        return -log_prob.masked_fill(~batch.action_sets, -torch.inf).logsumexp(-1)
    if batch.actions is None:
        raise ValueError("Inverse dynamics trains on labeled segments; the batch carries no actions.")
    return -log_prob.gather(-1, batch.actions.unsqueeze(-1)).squeeze(-1)
