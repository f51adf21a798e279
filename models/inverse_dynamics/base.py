"""What every inverse dynamics model offers, and the likelihood of a label that is a set of actions."""

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from models.network import Network
from models.segments import Observations, SegmentBatch


class ActionInference(Protocol):
    """All that the cycle asks of inverse dynamics: equation 5."""

    def infer(self, observations: Observations) -> Tensor:
        """Observations (B, L+1, ...) -> actions (B, L) or (B, L, D)."""
        ...


class InverseDynamics(Network, Protocol):
    """h_psi: the action between two observations. The loss raises ValueError for a batch without actions.

    It reads some of an observation's coordinates: its mask M.
    """

    def infer(self, observations: Observations) -> Tensor:
        """Equation 5: observations (B, L+1, ...) -> actions (B, L) or (B, L, D)."""
        ...

    @property
    def coordinates(self) -> int:
        """How many there are."""
        ...

    def kept(self, observations: Observations) -> Tensor:
        """How many of each first observation's are read: (B, L+1, ...) -> int64 (B,)."""
        ...


@runtime_checkable
class ActionProbabilities(Protocol):
    """What inverse dynamics over a finite set of actions says, and over a box does not."""

    def log_prob(self, batch: SegmentBatch) -> Tensor:
        """log p(a | x_t, x_{t+1}) for every action -> (B, L, n)."""
        ...


class DiscreteInverseDynamics(InverseDynamics, ActionProbabilities, Protocol):
    """Inverse dynamics over a finite set of actions."""


@runtime_checkable
class VerifyingBlock(Protocol):
    """Inverse dynamics that splits each step of segments (B, L+1, ...) into what it reads and what it leaves out.

    Both parts are vectors in which half a squared distance is how far two steps are apart; where the coordinates are
    one-hot codes that is the number of codes that differ.
    """

    def views(self, batch: SegmentBatch) -> SegmentBatch:
        """All that its training shows in the place of labeled segments, themselves first: (B,) -> (V*B,)."""
        ...

    def verifying_block(self, observations: Observations) -> Tensor:
        """z_S of x_t and x_{t+1}: (B*L, D)."""
        ...

    def rest(self, observations: Observations) -> Tensor:
        """The coordinates of x_t and x_{t+1} outside of the mask: (B*L, E), with an E of 0 where it reads all."""
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
