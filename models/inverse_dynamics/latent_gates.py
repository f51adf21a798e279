"""Inverse dynamics of robots with a learned mask M: hard-concrete gates over proprioceptive and latent coordinates.

a_t = h_psi(M * c_t, M * (c_{t+1} - c_t), M * (c_t - c_{t-1}))
loss = error(a_t) + sparsity * E[number of open gates] + image error

c are a frame's coordinates: the numbers of its vectors, and a latent of its images, trained to show them on action-free
segments too. A gate is exactly 0 or 1 in the end, so that what is closed is not read at all. An arm goes on as it went:
which force it felt, two poses do not tell, but three do. Of a segment's first step there are two, and it is told so.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.inverse_dynamics.boxes import BoxHead, check_labels, labels
from models.inverse_dynamics.gates import GAIN, OPEN
from models.networks.frame_coordinates import FrameCoordinates
from models.networks.gates import PenaltyRamp, inference_gates, open_probability, sample_gates
from models.networks.initialisation import initialise, table
from models.networks.moments import Moments
from models.networks.streams import check_finite, parts
from models.segments import Observations, SegmentBatch, concatenate
from models.spaces import Spaces


@dataclass(frozen=True)
class LatentGatesConfig:
    """sparsity: what an open gate costs, full after `free` + `ramp` losses; 0.1 is as much as to be off by 0.3 in one
    coordinate of an action.

    hidden: widths of what tells the action. latent, depth: of the images' encoder. window: observations of a training
    sequence.
    """

    sparsity: float = 0.1
    free: int = 150
    ramp: int = 250
    hidden: tuple[int, ...] = (128, 128)
    latent: int = 32
    depth: int = 8
    window: int = 4

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(self.hidden))  # JSON has lists


SMALL = LatentGatesConfig()
PAPER = LatentGatesConfig(free=2000, ramp=8000, hidden=(1024, 1024, 1024), latent=64, depth=32, window=8)


class LatentMaskedInverseDynamics(nn.Module):
    """A gate a coordinate, the same for all inputs. Reads any streams of a robot."""

    family = "robot"
    kind = "masked_inverse_dynamics"

    def __init__(self, spaces: Spaces, config: LatentGatesConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        self.frame = FrameCoordinates(spaces, config.latent, config.depth)
        self.change = Moments(self.frame.size)
        self.gates = table(1, self.frame.size, 0.01)
        self.penalty = PenaltyRamp(config.sparsity, config.free, config.ramp)
        self.head = BoxHead(3 * self.frame.size + 1, config.hidden, spaces)
        initialise(self, generator)

    @property
    def coordinates(self) -> int:
        """Of a frame."""
        return self.frame.size

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for numbers that are not finite and for actions outside of the spaces."""
        check_finite(batch)
        check_labels(batch, self.head.box)

    def infer(self, observations: Observations) -> Tensor:
        """Actions (B, L, D) in [-1, 1]."""
        gates = self.open_gates()
        return torch.cat([self.head.actions(self._told(self.frame(part), gates)) for part in parts(observations)])

    @torch.no_grad()
    def open_gates(self) -> Tensor:
        """How far each coordinate's gate is open: (C,) in [0, 1]."""
        return inference_gates(self._gates()).squeeze(0)

    def kept(self, observations: Observations) -> Tensor:
        """Open coordinates, the same for each first frame: int64 (B,)."""
        return (self.open_gates() > 0).sum().expand(SegmentBatch(observations).size)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Of labeled segments alone; the generator samples gates. Raises ValueError for a batch without actions."""
        batch = batch.windows(self.config.window - 1, generator)
        return self._loss(batch, batch.observations, generator)

    def semi_supervised_loss(
        self, labeled: SegmentBatch, action_free: SegmentBatch, generator: torch.Generator
    ) -> Tensor:
        """The images of all segments, actions of the labeled ones."""
        window = self.config.window - 1
        labeled, action_free = labeled.windows(window, generator), action_free.windows(window, generator)
        both = concatenate([labeled.without_labels(), action_free.without_labels()])
        return self._loss(labeled, both.observations, generator)

    def views(self, batch: SegmentBatch) -> SegmentBatch:
        """Training shows segments as they are."""
        return batch

    @torch.no_grad()
    def verifying_block(self, observations: Observations) -> Tensor:
        """z_S: the open coordinates of both frames, times their gates: (B*L, 2*kept)."""
        gates = self.open_gates()
        return _pairs((gates * self.frame(observations))[..., gates > 0])

    @torch.no_grad()
    def rest(self, observations: Observations) -> Tensor:
        """The closed coordinates of both frames: (B*L, 2*(C-kept))."""
        return _pairs(self.frame(observations)[..., self.open_gates() == 0])

    def _loss(self, labeled: SegmentBatch, observations: Observations, generator: torch.Generator) -> Tensor:
        actions = labels(labeled)
        if torch.is_grad_enabled():
            self.frame.measure(observations)
        c = self.frame(observations)  # (B, L+1, C), the labeled segments first
        if torch.is_grad_enabled():
            self.change.update(c.detach().diff(dim=1).flatten(0, 1))
        gates = self._gates()
        told = self._told(c[: labeled.size], sample_gates(gates, generator))
        cost = self.penalty() * open_probability(gates).sum()
        loss: Tensor = self.head.error(told, actions).mean() + cost + self.frame.error(c, observations)
        return loss

    def _gates(self) -> Tensor:
        return GAIN * self.gates + OPEN  # (1, C)

    def _told(self, c: Tensor, gates: Tensor) -> Tensor:
        """Coordinates (B, L+1, C) -> what is told of actions (B, L, D)."""
        change = gates * self.change.standardised(c.diff(dim=1))
        before = torch.cat((torch.zeros_like(change[:, :1]), change[:, :-1]), 1)
        first = torch.zeros_like(change[..., :1])
        first[:, 0] = 1.0
        told: Tensor = self.head(torch.cat((gates * c[:, :-1], change, before, first), -1))
        return told


def _pairs(c: Tensor) -> Tensor:
    """(B, L+1, C) -> (B*L, 2*C)."""
    return torch.cat((c[:, :-1], c[:, 1:]), -1).flatten(0, 1)
