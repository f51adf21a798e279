"""Inverse dynamics of grid worlds: sparse (what the action touches) and dense (both whole frames)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.inverse_dynamics.base import negative_log_likelihood
from models.inverse_dynamics.elements import (
    ElementPairs,
    action_count,
    element_words,
    pairs,
    steps,
    touched_elements,
)
from models.inverse_dynamics.grid_base import GridInverseDynamics
from models.networks import grid as cells
from models.networks.initialisation import initialise
from models.networks.symmetry import turned
from models.segments import Observations, SegmentBatch
from models.spaces import Spaces

TOUCHED = 3  # the agent's cell, the one in front, the hand


@dataclass(frozen=True)
class SparseInverseDynamicsConfig:
    """Widths of the two hidden layers; share of an element's channels hidden in training."""

    hidden: int = 256
    dropout: float = 0.2


@dataclass(frozen=True)
class DenseInverseDynamicsConfig:
    """Channels of the two convolutions, width of the hidden layer."""

    channels: int = 32
    hidden: int = 64


class GridSparseInverseDynamics(GridInverseDynamics):
    """Reads M*x_t and M*x_{t+1}: the agent's cell and the cell in front of it, both fixed by x_t, and the hand."""

    kind = "inverse_dynamics"

    def __init__(self, spaces: Spaces, config: SparseInverseDynamicsConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        self.head = ElementPairs(TOUCHED, config.hidden, action_count(spaces), config.dropout)
        initialise(self, generator)

    def log_prob(self, batch: SegmentBatch) -> Tensor:
        """(B, L, n)."""
        return self._log_prob(batch.observations)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean negative log-likelihood of the labels; the generator turns the rooms and hides channels."""
        batch = turned(batch, generator)
        return negative_log_likelihood(self._log_prob(batch.observations, generator), batch).mean()

    def kept(self, observations: Observations) -> Tensor:
        """Elements of each first frame that are read: int64 (B,)."""
        grid = observations["grid"]
        return torch.full((len(grid),), TOUCHED, device=grid.device)

    def verifying_block(self, observations: Observations) -> Tensor:
        """z_S: the channels of the six elements, each one-hot: uint8 (B*L, 6*22)."""
        return torch.cat([cells.one_hot(elements) for elements in touched_elements(*pairs(observations))], 1).flatten(1)

    def rest(self, observations: Observations) -> Tensor:
        """All cells of both frames, one-hot but for the touched ones, which are zero: uint8 (B*L, 2*S*S*22).

        A cell that only one of two steps touches counts half as much as one that differs.
        """
        before, after = pairs(observations)
        touched = cells.touched_cells(before["grid"]).unsqueeze(2).expand(-1, -1, cells.WORDS)
        frames = [cells.one_hot(frame["grid"].flatten(1, 2)).scatter_(1, touched, 0) for frame in (before, after)]
        return torch.cat(frames, 1).flatten(1)

    def _log_prob(self, observations: Observations, generator: torch.Generator | None = None) -> Tensor:
        words = element_words(*touched_elements(*pairs(observations)))
        logits: Tensor = self.head(words, generator)
        return logits.log_softmax(-1).view(-1, steps(observations), logits.shape[-1])


class GridDenseInverseDynamics(GridInverseDynamics):
    """Vanilla inverse dynamics: both whole frames and what is carried through a coordinate convolution network."""

    kind = "dense_inverse_dynamics"

    def __init__(self, spaces: Spaces, config: DenseInverseDynamicsConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        size = spaces.observations["grid"].shape[0]
        self.encoder = cells.GridEncoder(size, config.channels, frames=2)
        self.head = cells.PooledHead(size, config.channels, config.hidden, action_count(spaces))
        initialise(self, generator)

    def log_prob(self, batch: SegmentBatch) -> Tensor:
        """(B, L, n)."""
        return self._log_prob(batch.observations)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean negative log-likelihood of the labels; the generator turns the rooms."""
        return negative_log_likelihood(self.log_prob(turned(batch, generator)), batch).mean()

    def kept(self, observations: Observations) -> Tensor:
        """All elements: int64 (B,)."""
        grid = observations["grid"]
        return torch.full((len(grid),), self.coordinates, device=grid.device)

    def verifying_block(self, observations: Observations) -> Tensor:
        """It reads everything: all cells and the hand of both frames, one-hot: uint8 (B*L, 2*(S*S+1)*22)."""
        frames = [
            cells.one_hot(torch.cat((frame["grid"].flatten(1, 2), frame["carried"].unsqueeze(1)), 1))
            for frame in pairs(observations)
        ]
        return torch.cat(frames, 1).flatten(1)

    def rest(self, observations: Observations) -> Tensor:
        """Nothing: (B*L, 0)."""
        return observations["grid"].new_zeros(len(observations["grid"]) * steps(observations), 0)

    def _log_prob(self, observations: Observations) -> Tensor:
        logits: Tensor = self.head(self.encoder(pairs(observations)))
        return logits.log_softmax(-1).view(-1, steps(observations), logits.shape[-1])
