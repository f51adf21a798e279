"""Inverse dynamics of grid worlds: sparse (what the action touches) and dense (both whole frames)."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.inverse_dynamics.base import negative_log_likelihood
from models.networks import grid as cells
from models.networks.initialisation import initialise, table
from models.networks.mlp import Mlp
from models.segments import Observations, SegmentBatch
from models.spaces import DiscreteAction, Spaces


@dataclass(frozen=True)
class SparseInverseDynamicsConfig:
    """Widths of the two hidden layers."""

    hidden: int = 64


@dataclass(frozen=True)
class DenseInverseDynamicsConfig:
    """Channels of the two convolutions, width of the hidden layer."""

    channels: int = 32
    hidden: int = 64


class GridSparseInverseDynamics(nn.Module):
    """Reads M*x_t and M*x_{t+1}: the agent's cell and the cell in front of it, both fixed by x_t, and the hand.

    Six elements (two cells and the hand, at both times), each one-hot in object, colour and state.
    """

    family = "grid"
    kind = "inverse_dynamics"

    def __init__(self, spaces: Spaces, config: SparseInverseDynamicsConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        # A linear layer over one-hot inputs is a sum of rows: (6 elements * 22 words, hidden).
        self.rows = table(6 * cells.WORDS, config.hidden, 0.3)
        self.mlp = Mlp((config.hidden, config.hidden, _actions(spaces)))
        initialise(self, generator)

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for values outside the vocabulary."""
        cells.check(batch.observations)

    def log_prob(self, batch: SegmentBatch) -> Tensor:
        """(B, L, n)."""
        return self._log_prob(batch.observations)

    def infer(self, observations: Observations) -> Tensor:
        """The most likely actions, int64 (B, L)."""
        return self._log_prob(observations).argmax(-1)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean negative log-likelihood of the labels. Draws nothing from the generator."""
        return negative_log_likelihood(self.log_prob(batch), batch).mean()

    def _log_prob(self, observations: Observations) -> Tensor:
        before, after = _pairs(observations)
        touched = cells.touched_cells(before["grid"])  # (B*L, 2)
        elements = torch.cat(
            [
                part
                for frame in (before, after)
                for part in (cells.gather_cells(frame["grid"].flatten(1, 2), touched), frame["carried"].unsqueeze(1))
            ],
            1,
        )  # (B*L, 6, 3)
        offsets = torch.arange(6, device=elements.device).unsqueeze(1) * cells.WORDS
        channels = torch.tensor((0, cells.OBJECTS, cells.OBJECTS + cells.COLOURS), device=elements.device)
        words = (elements.long() + offsets + channels).flatten(1)  # (B*L, 18)
        hidden = F.embedding_bag(words, self.rows, mode="sum")
        logits: Tensor = self.mlp(hidden.relu())
        return logits.log_softmax(-1).view(-1, _steps(observations), logits.shape[-1])


class GridDenseInverseDynamics(nn.Module):
    """Vanilla inverse dynamics: both whole frames and what is carried through a coordinate convolution network."""

    family = "grid"
    kind = "dense_inverse_dynamics"

    def __init__(self, spaces: Spaces, config: DenseInverseDynamicsConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        size = spaces.observations["grid"].shape[0]
        self.encoder = cells.GridEncoder(size, config.channels, frames=2)
        self.head = cells.PooledHead(size, config.channels, config.hidden, _actions(spaces))
        initialise(self, generator)

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for values outside the vocabulary."""
        cells.check(batch.observations)

    def log_prob(self, batch: SegmentBatch) -> Tensor:
        """(B, L, n)."""
        return self._log_prob(batch.observations)

    def infer(self, observations: Observations) -> Tensor:
        """The most likely actions, int64 (B, L)."""
        return self._log_prob(observations).argmax(-1)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean negative log-likelihood of the labels. Draws nothing from the generator."""
        return negative_log_likelihood(self.log_prob(batch), batch).mean()

    def _log_prob(self, observations: Observations) -> Tensor:
        logits: Tensor = self.head(self.encoder(_pairs(observations)))
        return logits.log_softmax(-1).view(-1, _steps(observations), logits.shape[-1])


def _actions(spaces: Spaces) -> int:
    if not isinstance(spaces.action, DiscreteAction):
        raise TypeError(f"Grid inverse dynamics needs a discrete action space, got {spaces.action}.")
    return spaces.action.n


def _steps(observations: Observations) -> int:
    return int(observations["grid"].shape[1]) - 1


def _pairs(observations: Observations) -> tuple[Observations, Observations]:
    """(B, L+1, ...) -> x_t and x_{t+1}, each (B*L, ...)."""
    before = {name: stream[:, :-1].flatten(0, 1) for name, stream in observations.items()}
    return before, {name: stream[:, 1:].flatten(0, 1) for name, stream in observations.items()}
