"""Inverse dynamics of grid worlds with a learned mask M: hard-concrete gates over cells or over a latent's coordinates.

a_t = h_psi(M * x_t, M * x_{t+1}),   loss = -log p(a_t) + sparsity * E[number of open gates]
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from models.inverse_dynamics.base import negative_log_likelihood
from models.inverse_dynamics.elements import (
    ElementPairs,
    action_count,
    element_words,
    pairs,
    steps,
)
from models.inverse_dynamics.grid_base import GridInverseDynamics
from models.networks import grid as cells
from models.networks.coordinate_convolution import CoordinateConvolution
from models.networks.gates import PenaltyRamp, inference_gates, open_probability, sample_gates
from models.networks.initialisation import initialise, linear, table
from models.networks.mlp import Mlp
from models.networks.symmetry import turned
from models.segments import Observations, SegmentBatch
from models.spaces import Spaces

OPEN = 2.0  # added to every gate's logit, so that training begins with the gates open
GAIN = 10.0  # of a gate that is a parameter itself: Adam moves it by the learning rate, and there are few steps


@dataclass(frozen=True)
class MaskedInverseDynamicsConfig:
    """`over`: what the gates are over. `sparsity`: nats an open gate costs, reached after `free` + `ramp` losses.

    embedding, channels: of the convolution that sets the gates (cells) or encodes a frame (latent: channels alone).
    slots: ways of looking at the open cells. latent: coordinates of the encoded frame. hidden: width of the last layer.
    dropout: share of an element's channels hidden in training.
    """

    over: Literal["cells", "latent"] = "cells"
    sparsity: float = 0.01
    free: int = 240
    ramp: int = 320
    embedding: int = 16
    channels: int = 32
    slots: int = 2
    latent: int = 64
    hidden: int = 64
    dropout: float = 0.2

    def __post_init__(self) -> None:
        if self.over not in ("cells", "latent"):
            raise ValueError(f"over must be 'cells' or 'latent', got {self.over!r}.")


class GridCellMaskedInverseDynamics(GridInverseDynamics):
    """A gate a cell, and slots that each look at one of the open cells; the hand is always read.

    Slot k reads sum_c z_c w_kc (x_t, x_{t+1})_c with gates z and attention w_k (softmax over cells), so that the
    agent's cell and the one in front of it can be told apart by slot, not by position. Gates and attention come from
    x_t alone. A mask that saw x_{t+1} could tell the action by which cells it opens, whatever they hold; and it would
    move with the very prediction that is to be verified.
    """

    kind = "masked_inverse_dynamics"

    def __init__(self, spaces: Spaces, config: MaskedInverseDynamicsConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        size = spaces.observations["grid"].shape[0]
        self.embedding = cells.ElementEmbedding(config.embedding)
        self.convolution = CoordinateConvolution(config.embedding, config.channels, size, size)
        self.gates = linear(config.channels, 1 + config.slots)
        self.penalty = PenaltyRamp(config.sparsity, config.free, config.ramp)
        self.head = ElementPairs(config.slots + 1, config.hidden, action_count(spaces), config.dropout)
        initialise(self, generator)

    def log_prob(self, batch: SegmentBatch) -> Tensor:
        """(B, L, n)."""
        return self._log_prob(batch.observations)[0]

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean of the labels' negative log-likelihood and the penalty; the generator turns rooms and samples gates."""
        batch = turned(batch, generator)
        log_prob, gates = self._log_prob(batch.observations, generator)
        likelihood = negative_log_likelihood(log_prob, batch).mean()
        loss: Tensor = likelihood + self.penalty() * open_probability(gates).sum(1).mean()
        return loss

    @torch.no_grad()
    def kept(self, observations: Observations) -> Tensor:
        """Open cells of each first frame, and the hand: int64 (B,)."""
        gates, _ = self._look(observations["grid"][:, 0])
        return (inference_gates(gates) > 0).sum(1) + 1

    @torch.no_grad()
    def open_cells(self, grid: Tensor) -> Tensor:
        """Whether each cell of grid (B, S, S, 3) is read: bool (B, S*S)."""
        return inference_gates(self._look(grid)[0]) > 0

    @torch.no_grad()
    def verifying_block(self, observations: Observations) -> Tensor:
        """z_S: the cell each slot looks at most, zero where it is closed, and the hand, one-hot: (B*L, (K+1)*2*22)."""
        before, after = pairs(observations)
        gates, attention = self._look(before["grid"])
        weights = inference_gates(gates).unsqueeze(2) * attention  # (B*L, S*S, K)
        weight, place = weights.max(1)
        blocks = []
        for frame in (before, after):
            seen = cells.one_hot(cells.gather_cells(frame["grid"].flatten(1, 2), place)) * (weight > 0).unsqueeze(2)
            blocks += [seen, cells.one_hot(frame["carried"].unsqueeze(1))]
        return torch.cat(blocks, 1).flatten(1)

    @torch.no_grad()
    def rest(self, observations: Observations) -> Tensor:
        """All cells of both frames, one-hot but for the open ones, which are zero: uint8 (B*L, 2*S*S*22)."""
        before, after = pairs(observations)
        closed = ~self.open_cells(before["grid"]).unsqueeze(2)
        frames = [cells.one_hot(frame["grid"].flatten(1, 2)) * closed for frame in (before, after)]
        return torch.cat(frames, 1).flatten(1)

    def _look(self, grid: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of the gates (N, S*S), attention (N, S*S, K)."""
        h = self.convolution(self.embedding(grid)).relu_().flatten(1, 2)  # (N, S, S, C) -> (N, S*S, C)
        out: Tensor = self.gates(h)
        return out[..., 0] + OPEN, out[..., 1:].softmax(1)

    def _log_prob(self, observations: Observations, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        before, after = pairs(observations)
        gates, attention = self._look(before["grid"])
        z = inference_gates(gates) if generator is None else sample_gates(gates, generator)
        grids = [frame["grid"].flatten(1, 2) for frame in (before, after)]  # (N, S*S, 3)
        slots = torch.bmm((z.unsqueeze(2) * attention).transpose(1, 2), element_words(grids[0], grids[1]))
        hand = element_words(before["carried"].unsqueeze(1), after["carried"].unsqueeze(1))
        logits: Tensor = self.head(torch.cat((slots, hand), 1), generator)  # (N, K+1, 47) -> (N, n)
        return logits.log_softmax(-1).view(-1, steps(observations), logits.shape[-1]), gates


class GridLatentMaskedInverseDynamics(GridInverseDynamics):
    """A gate a coordinate of an encoded frame, the same for all inputs: the form that needs no cells.

    Each frame, hand included, is encoded to a vector by the same network; M multiplies both vectors.
    """

    kind = "masked_inverse_dynamics"

    def __init__(self, spaces: Spaces, config: MaskedInverseDynamicsConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        size = spaces.observations["grid"].shape[0]
        self.encoder = cells.GridEncoder(size, config.channels)
        self.pool = cells.PooledHead(size, config.channels, config.hidden, config.latent)
        self.gates = table(1, config.latent, 0.01)
        self.penalty = PenaltyRamp(config.sparsity, config.free, config.ramp)
        self.head = Mlp((2 * config.latent, config.hidden, action_count(spaces)))
        initialise(self, generator)

    @property
    def coordinates(self) -> int:
        """Coordinates of the latent."""
        return self.config.latent

    def log_prob(self, batch: SegmentBatch) -> Tensor:
        """(B, L, n)."""
        return self._log_prob(batch.observations, inference_gates(self._gates()))

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean of the labels' negative log-likelihood and the penalty; the generator turns rooms and samples gates."""
        batch = turned(batch, generator)
        gates = self._gates().expand(batch.size * batch.length, -1)
        log_prob = self._log_prob(batch.observations, sample_gates(gates, generator))
        likelihood = negative_log_likelihood(log_prob, batch).mean()
        loss: Tensor = likelihood + self.penalty() * open_probability(self._gates()).sum()
        return loss

    @torch.no_grad()
    def kept(self, observations: Observations) -> Tensor:
        """Open coordinates, the same for each first frame: int64 (B,)."""
        return (inference_gates(self._gates()) > 0).sum().expand(len(observations["grid"]))

    @torch.no_grad()
    def verifying_block(self, observations: Observations) -> Tensor:
        """z_S: the open coordinates of both frames, times their gates: (B*L, 2*kept)."""
        gates = inference_gates(self._gates()).squeeze(0)
        return torch.cat([(gates * z)[:, gates > 0] for z in self._encode(observations)], 1)

    @torch.no_grad()
    def rest(self, observations: Observations) -> Tensor:
        """The closed coordinates of both frames: (B*L, 2*(D-kept))."""
        gates = inference_gates(self._gates()).squeeze(0)
        return torch.cat([z[:, gates == 0] for z in self._encode(observations)], 1)

    def _gates(self) -> Tensor:
        return GAIN * self.gates + OPEN  # (1, D)

    def _encode(self, observations: Observations) -> tuple[Tensor, Tensor]:
        """z_t and z_{t+1}, each (B*L, D). Every frame is encoded once."""
        frames = {name: stream.flatten(0, 1) for name, stream in observations.items()}
        z: Tensor = self.pool(self.encoder((frames,))).view(*observations["grid"].shape[:2], -1)
        return z[:, :-1].flatten(0, 1), z[:, 1:].flatten(0, 1)

    def _log_prob(self, observations: Observations, gates: Tensor) -> Tensor:
        before, after = self._encode(observations)
        logits: Tensor = self.head(torch.cat((gates * before, gates * after), 1))
        return logits.log_softmax(-1).view(-1, steps(observations), logits.shape[-1])
