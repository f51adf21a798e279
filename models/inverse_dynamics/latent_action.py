"""Latent-action inverse dynamics (CLAM, Liang et al. 2025), sparse and dense: what happened first, then which action.

    z_t   = enc(x_{<=t}, x_{t+1})                            a latent action, from observations alone
    x^    = dec(x_{<=t}, z_t + noise)                        what it tells of the next observation
    a_t   = act(z_t)                                         which action it is
    loss  = |x^ - x_{t+1}|^2 + sparsity mean_i |z_ti|        of all segments
          + error(act(z_t + noise), a_t)                     of labeled segments, at every second update

|z| is smoothed, sqrt(z^2 + 1e-12). The noise has a fixed size: without it a small z before large weights would be as
good as a large one, and a price on z would buy nothing. The dense form is the same without the price.

Two faults of the reference are avoided. Its causal mask is a matrix of ones and zeros that is added to the scores, so
that the future is read all the same: here it is -inf (`PastBias`). Its layer norm runs over tokens and width together,
so that what one token holds rescales all others: here every token is normed by itself (`normalised`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models.inverse_dynamics.boxes import BoxHead, check_labels, labels
from models.networks.frame_changes import FrameChanges
from models.networks.initialisation import initialise, linear, table
from models.networks.space_time_transformer import SpaceTimeTransformer
from models.networks.streams import check_finite, parts
from models.networks.tokens import Tokens
from models.segments import Observations, SegmentBatch, concatenate
from models.spaces import Spaces

SMOOTHING = 1e-12


@dataclass(frozen=True)
class LatentActionConfig:
    """latent: coordinates of a latent action. sparsity: what they cost; 0 is the dense form. noise: deviation of what
    training adds to each. actor: widths of what decodes the action. every: updates from one action loss to the next.

    window: observations of a training sequence. width, layers, heads, hidden: of each transformer. context: frames that
    a layer looks back. patch: pixels a side.
    """

    latent: int = 16
    sparsity: float = 0.1
    noise: float = 0.1
    actor: tuple[int, ...] = (128, 128)
    every: int = 2
    window: int = 5
    width: int = 64
    layers: int = 2
    heads: int = 2
    hidden: int = 128
    context: int = 1
    patch: int = 16

    def __post_init__(self) -> None:
        object.__setattr__(self, "actor", tuple(self.actor))  # JSON has lists
        if self.sparsity < 0.0 or self.every < 1 or self.window < 2:
            found = f"{self.sparsity}, {self.every} and {self.window}"
            raise ValueError(f"sparsity must be at least 0, every at least 1 and window at least 2, got {found}.")


SMALL = LatentActionConfig()
PAPER = LatentActionConfig(actor=(1024, 1024, 1024), window=8, width=256, layers=3, heads=4, hidden=2048)
"""The reference's sizes; three layers that look one frame back each see its three frames."""


class LatentActionInverseDynamics(nn.Module):
    """Reads any streams of a robot: cameras, vectors or both. Segments may have any length.

    Errors of reconstruction are shares of what a step usually changes: 1 where nothing is foreseen.
    """

    family = "robot"
    updates: Tensor

    def __init__(self, spaces: Spaces, config: LatentActionConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.spaces, self.config = spaces, config
        width = config.width
        shape = (width, config.layers, config.heads, config.hidden, config.context)
        self.frames = FrameChanges(spaces)
        self.tokens = Tokens(self.frames.streams, width, config.patch)
        self.question = table(1, width)  # the token that becomes the latent action
        self.encoder = SpaceTimeTransformer(*shape)
        self.latent = linear(width, config.latent)
        self.answer = linear(config.latent, width)
        self.decoder_tokens = Tokens(self.frames.streams, width, config.patch)
        self.decoder = SpaceTimeTransformer(*shape)
        self.actor = BoxHead(config.latent, config.actor, spaces)
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))
        initialise(self, generator)

    @property
    def kind(self) -> str:
        """The sparse form, or the dense one that it is compared with."""
        return "inverse_dynamics" if self.config.sparsity else "dense_inverse_dynamics"

    @property
    def coordinates(self) -> int:
        """Of a latent action."""
        return self.config.latent

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for numbers that are not finite and for actions outside of the spaces."""
        check_finite(batch)
        check_labels(batch, self.actor.box)

    def encode(self, observations: Observations) -> Tensor:
        """Latent actions: (B, L+1, ...) -> (B, L, Z). Each depends on no later observation than x_{t+1}."""
        return torch.cat([self._encode(*self.frames(part)) for part in parts(observations)])

    def infer(self, observations: Observations) -> Tensor:
        """Actions (B, L, D) in the box."""
        return self.actor.actions(self.actor(self.encode(observations)))

    def reconstruct(self, observations: Observations, latent: Tensor) -> Observations:
        """What follows each observation but the last: (B, L+1, ...), (B, L, Z) -> (B, L, ...), in the space's dtype."""
        values, changes = self.frames(observations)
        now = {name: stream[:, :-1] for name, stream in observations.items()}
        return self.frames.following(now, self._foresee(values, changes, latent))

    def reconstruction_error(self, observations: Observations) -> Tensor:
        """Of segments (B, L+1, ...) -> (B,): mean over steps, of pixels and of each vector alike."""
        values, changes = self.frames(observations)
        return self._error(values, changes, self._encode(values, changes))

    def kept(self, observations: Observations) -> Tensor:
        """Coordinates of each segment's latent actions that stand out from the noise: int64 (B,)."""
        return (self.encode(observations).abs().amax(1) > self.config.noise).sum(1)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Of labeled segments alone. Raises ValueError for a batch without actions."""
        batch = self._window(batch, generator)
        return self._loss(batch, batch.observations, generator)

    def semi_supervised_loss(
        self, labeled: SegmentBatch, action_free: SegmentBatch, generator: torch.Generator
    ) -> Tensor:
        """Reconstruction of all segments, actions of the labeled ones; the generator draws windows and the noise."""
        labeled, action_free = self._window(labeled, generator), self._window(action_free, generator)
        both = concatenate([labeled.without_labels(), action_free.without_labels()])
        return self._loss(labeled, both.observations, generator)

    def _window(self, batch: SegmentBatch, generator: torch.Generator) -> SegmentBatch:
        return batch.windows(self.config.window - 1, generator)

    def _loss(self, labeled: SegmentBatch, observations: Observations, generator: torch.Generator) -> Tensor:
        actions = labels(labeled)
        if torch.is_grad_enabled():
            self.frames.measure(observations)
        values, changes = self.frames(observations)
        z = self._encode(values, changes)
        draw = torch.randn(z.shape, generator=generator, device=generator.device).to(z.device)
        noisy = z + self.config.noise * draw
        size = (z.square() + SMOOTHING).sqrt().mean()
        loss = self._error(values, changes, noisy).mean() + self.config.sparsity * size
        self.updates += 1
        if int(self.updates) % self.config.every == 0:
            loss = loss + self.actor.error(self.actor(noisy[: labeled.size]), actions).mean() / actions.shape[-1]
        return loss

    def _encode(self, values: Sequence[Tensor], changes: Sequence[Tensor]) -> Tensor:
        tokens = self.tokens(values, changes)  # (B, T, N, D)
        question = self.question.expand(*tokens.shape[:2], 1, -1)
        read = self.encoder(torch.cat((question, tokens), 2))[:, 1:, 0]  # (B, T, N+1, D) -> (B, L, D)
        z: Tensor = self.latent(read)
        return z

    def _foresee(self, values: Sequence[Tensor], changes: Sequence[Tensor], latent: Tensor) -> list[Tensor]:
        """What changes next, standardised: pixels and vectors (B, L, ...).

        The latent action is added to every token: attention to a single token is no more than that.
        """
        tokens = self.decoder_tokens([each[:, :-1] for each in values], [each[:, :-1] for each in changes])
        told = tokens + self.answer(latent).unsqueeze(2)  # (B, L, N, D)
        return self.decoder_tokens.written(self.decoder(told))

    def _error(self, values: Sequence[Tensor], changes: Sequence[Tensor], latent: Tensor) -> Tensor:
        """(B,)."""
        foreseen = zip(self._foresee(values, changes, latent), changes, strict=True)
        errors = [(guess - change).square().flatten(1).mean(1) for guess, change in foreseen]
        return torch.stack(errors).mean(0)
