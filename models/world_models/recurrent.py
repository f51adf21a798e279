"""World model of robots: a recurrent state-space model over images and numbers (Hafner et al. 2023, DreamerV3)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from models.networks import categorical, image
from models.networks.initialisation import initialise
from models.networks.observation import (
    Frame,
    ObservationDecoder,
    ObservationEncoder,
    ObservationNetworkConfig,
    Streams,
)
from models.networks.recurrent_state_space import RecurrentStateSpace, RecurrentStateSpaceConfig
from models.segments import Observations, SegmentBatch
from models.spaces import Spaces, bounded_box

VISIBLE_GREY, VISIBLE = 16.0, 1e-3  # of 255 levels, and of a number: what is less is no change
FRAMES = 512  # encoded or decoded at a time outside of training: bounds memory
Distance = Literal["divergence", "decoded"]


@dataclass(frozen=True)
class RecurrentWorldModelConfig(RecurrentStateSpaceConfig, ObservationNetworkConfig):
    """The paper's preset. window: observations of a training sequence.

    standardised: whether numbers are, besides symlog; numbers_weight: of their squared error in the loss. distance:
    what `distance` returns: nats of divergence in latent space, or the squared error of what is decoded.
    """

    window: int = 32
    standardised: bool = False
    numbers_weight: float = 1.0
    dynamics_weight: float = 0.5
    representation_weight: float = 0.1
    free_nats: float = 1.0
    distance: Distance = "divergence"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.distance not in get_args(Distance):
            raise ValueError(f"distance must be one of {', '.join(get_args(Distance))}, got {self.distance!r}.")
        if self.window < 2:
            raise ValueError(f"window must be at least 2, got {self.window}.")


PAPER = RecurrentWorldModelConfig()
SMALL = RecurrentWorldModelConfig(
    deterministic=256,
    groups=16,
    classes=16,
    hidden=256,
    depth=16,
    units=256,
    layers=2,
    window=16,
    reads_first=True,
    standardised=True,
    numbers_weight=10.0,
)


class RecurrentWorldModel(nn.Module):
    """States are (B, D) = [h, z]; a state after one observation knows no velocities, so the burn-in is one observation.

    Distances are nats, what the observations tell that the predicted states did not expect, or errors of what these
    decode to: the config says which.
    """

    family = "robot"
    kind = "world_model"
    symbolic = False

    def __init__(self, spaces: Spaces, config: RecurrentWorldModelConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.streams = Streams(spaces, config.standardised)  # refuses spaces that do not fit
        self.spaces, self.config, self.action = spaces, config, bounded_box(spaces)
        self.encoder = ObservationEncoder(self.streams, config)
        self.recurrence = RecurrentStateSpace(self.action.shape[0], self.encoder.outputs, config)
        self.decoder = ObservationDecoder(config.state, self.streams, config)
        initialise(self, generator)

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for numbers that are not finite, naming the segment."""
        streams = {name: batch.observations[name] for name in self.streams.vectors}
        if batch.actions is not None:
            streams["actions"] = batch.actions
        for name, stream in streams.items():
            broken = (~stream.isfinite()).flatten(1).any(1).nonzero().flatten()
            if len(broken):
                where = batch.name(int(broken[0]))
                raise ValueError(f"{name} of segment {where} holds a number that is not finite.")

    def encode(self, observations: Observations) -> Tensor:
        """Streams (B, ...) -> states (B, D) of trajectories that begin there."""
        return self.infer_state({name: stream.unsqueeze(1) for name, stream in observations.items()})

    def predict(self, state: Tensor, actions: Tensor) -> Tensor:
        """(B, D), (B, A) -> (B, D): z is the prior's mode, so that nothing is drawn."""
        return self.rollout(state, actions.unsqueeze(1))[:, 0]

    def decode(self, state: Tensor) -> Observations:
        """(B, D) -> means, as the loss compares them: pixels (B, S, S, 3 * cameras), numbers (B, N)."""
        frame = self._decoded(state)
        return {name: part for name, part in zip(Frame._fields, frame, strict=True) if part is not None}

    def observe(self, state: Tensor) -> Observations:
        """(B, D) -> the means as observations: uint8 images (B, S, S, 3), vectors in their units."""
        streams = self.streams.restored(self._decoded(state))
        return {
            name: image.as_bytes(stream) if name in self.streams.cameras else stream for name, stream in streams.items()
        }

    def infer_state(
        self, observations: Observations, actions: Tensor | None = None, context: Tensor | None = None
    ) -> Tensor:
        """(B, T, ...), actions (B, T-1, A), or (B, T, A) with a context (B, D) -> (B, D) at the last, modes throughout.

        Raises ValueError where actions are missing: they can be left out for a single observation only.
        """
        embeddings = self._read(observations)
        batch, steps = embeddings.shape[:2]
        expected = steps - (context is None)
        if actions is None and expected == 0:
            actions = embeddings.new_zeros(batch, 0, *self.action.shape)
        if actions is None or actions.shape[1] != expected:
            found = "none" if actions is None else str(actions.shape[1])
            raise ValueError(f"{steps} observations have {expected} actions between them, got {found}.")
        return self.recurrence.filter(embeddings, self.action.unit(actions), context=context).states[:, -1]

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """(B, D), (B, L, A) -> (B, L, D)."""
        return self.recurrence.imagine(state, self.action.unit(actions))

    def distance(self, prediction: Tensor, reference: Observations) -> Tensor:
        """Summed over the steps: (B, L, D), (B, L, ...) -> (B,), by the config's `distance`.

        divergence: sum_t KL(q(z_t | h_t, x_t) || p(z_t | h_t)) along predicted h_t, in nats: the information that each
        observation adds to what the rollout expected, which is the dynamics loss, open-loop. decoded: the squared error
        of pixels and, weighed as in the loss, ln(1 + it) of each standardised number, as of a Cauchy distribution.
        Raises ValueError for other shapes.
        """
        found, expected = tuple(prediction.shape[:2]), _leading(reference)
        if found != expected:
            raise ValueError(f"predictions {found} are of other steps than {expected}.")
        if self.config.distance == "decoded":
            return self._decoded_distance(prediction, reference)
        h, _ = self.recurrence.split(prediction)
        posterior = self.recurrence.posterior(h, self._read(reference))
        return categorical.kl_divergence(posterior, self.recurrence.prior(h)).sum(1)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean over the observations of windows of the segments; see `forward`. The generator draws windows and z."""
        if batch.actions is None:
            raise ValueError("The recurrent world model trains on labeled segments; the batch carries no actions.")
        batch = batch.windows(self.config.window - 1, generator)
        assert batch.actions is not None  # noqa: S101  # they were above
        if torch.is_grad_enabled():
            self.streams.measure(batch.observations)
        shape = (batch.size, batch.length + 1, self.config.groups)
        uniform = torch.rand(shape, generator=generator, device=generator.device).to(batch.actions.device)
        loss: Tensor = self(batch.observations, batch.actions, uniform)
        return loss

    def forward(self, observations: Observations, actions: Tensor, uniform: Tensor) -> Tensor:
        """-log p(x | h, z) + .5 max(1, KL(sg q || p)) + .1 max(1, KL(q || sg p)), mean over B and T.

        (B, T, ...), (B, T-1, A), uniform (B, T, G). -log p is the squared error, summed over pixels and numbers.
        Encoder, prior and decoder run over B*T at once.
        """
        frame = self.streams.frame(observations)
        states, divergence = self.latent(self.embed(frame), actions, uniform)
        return (self.reconstruction(states, frame) + divergence).mean()

    def embed(self, frame: Frame) -> Tensor:
        """Frames (B, T, ...) -> embeddings (B, T, E)."""
        some = frame.pixels if frame.pixels is not None else frame.numbers
        assert some is not None  # noqa: S101  # there is a stream
        embeddings: Tensor = self.encoder(frame.flat(2))
        return embeddings.view(*some.shape[:2], -1)

    def latent(self, embeddings: Tensor, actions: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """States (B, T, D) drawn by uniform (B, T, G), and the loss (B, T) of their divergence from the prior."""
        states, posterior = self.recurrence.filter(embeddings, self.action.unit(actions), uniform)
        prior = self.recurrence.prior(self.recurrence.split(states)[0])
        dynamics = categorical.kl_divergence(posterior.detach(), prior).clamp(min=self.config.free_nats)
        representation = categorical.kl_divergence(posterior, prior.detach()).clamp(min=self.config.free_nats)
        config = self.config
        return states, config.dynamics_weight * dynamics + config.representation_weight * representation

    def reconstruction(self, states: Tensor, frame: Frame) -> Tensor:
        """Squared error of what states (B, T, D) decode to, summed over a frame's pixels and numbers: (B, T)."""
        return self._missed(states.flatten(0, 1), frame.flat(2), tolerant=False).view(states.shape[:2])

    def disagreement(self, decoded: Sequence[Observations]) -> Tensor:
        """Variance over the members of what they decode, summed over pixels and numbers, weighted as in the loss."""
        total = None
        for name, weight in (("pixels", 1.0), ("numbers", self.config.numbers_weight)):
            if name not in decoded[0]:
                continue
            members = torch.stack([member[name] for member in decoded]).flatten(2)  # (members, B, N)
            spread = weight * members.var(0, unbiased=False).sum(1)
            total = spread if total is None else total + spread
        assert total is not None  # noqa: S101  # there is a stream
        return total

    def latent_features(self, observations: Observations, actions: Tensor) -> Tensor:
        """Predicted h, mean over steps -> (B, deterministic)."""
        state = self.encode({name: stream[:, 0] for name, stream in observations.items()})
        return self.recurrence.split(self.rollout(state, actions))[0].mean(1)

    def signatures(self, observations: Observations, actions: Tensor) -> Tensor:
        """Which way each coordinate of the mean action points, and each number moves: int64 (B, A + N) of -1, 0, 1.

        Actions of less than a third of the box count as none, and so do moves of less than half a deviation.
        """
        parts = [_sign(self.action.unit(actions).mean(1), 1 / 3)]
        numbers = self.streams.frame(observations).numbers
        if numbers is not None:
            parts.append(_sign(numbers[:, -1] - numbers[:, 0], 1 / 2))
        return torch.cat(parts, 1)

    def changes(self, prediction: Tensor, observations: Observations) -> tuple[Tensor, Tensor]:
        """A pixel's colour or a number that changed visibly is right where less than half of its change is missing."""
        guess = self.observe(prediction)
        correct = torch.zeros(len(prediction), dtype=torch.int64, device=prediction.device)
        changed = torch.zeros_like(correct)
        for name, stream in observations.items():
            before, after = stream[:, 0].float(), stream[:, 1].float()
            change = (after - before).abs()
            visible = change > (VISIBLE_GREY if name in self.streams.cameras else VISIBLE)
            hit = visible & ((guess[name] - after).abs() < change / 2)
            correct += hit.flatten(1).sum(1)
            changed += visible.flatten(1).sum(1)
        return correct, changed

    def _read(self, observations: Observations) -> Tensor:
        """(B, T, ...) -> embeddings (B, T, E), a part of the frames at a time: as floats all may be too many."""
        batch, steps = _leading(observations)
        rows = {name: stream.flatten(0, 1) for name, stream in observations.items()}
        parts = [
            self.encoder(self.streams.frame({name: stream[start : start + FRAMES] for name, stream in rows.items()}))
            for start in range(0, max(1, batch * steps), FRAMES)
        ]
        return torch.cat(parts).view(batch, steps, self.encoder.outputs)

    def _decoded_distance(self, prediction: Tensor, reference: Observations) -> Tensor:
        """A part of the frames at a time, as in `_read`."""
        rows, states = {name: stream.flatten(0, 1) for name, stream in reference.items()}, prediction.flatten(0, 1)
        parts = []
        for start in range(0, max(1, len(states)), FRAMES):
            frame = self.streams.frame({name: stream[start : start + FRAMES] for name, stream in rows.items()})
            parts.append(self._missed(states[start : start + FRAMES], frame, tolerant=True))
        return torch.cat(parts).view(prediction.shape[:2]).sum(1)

    def _missed(self, states: Tensor, frame: Frame, tolerant: bool) -> Tensor:
        """Squared error of what states (N, D) decode to, summed over a frame's pixels and numbers: (N,).

        tolerant: a number's counts as ln(1 + it), so that one which has never moved so far does not outweigh pictures.
        """
        decoded, parts = self._decoded(states), []
        if decoded.pixels is not None and frame.pixels is not None:
            parts.append(image.squared_error(decoded.pixels, frame.pixels))
        if decoded.numbers is not None and frame.numbers is not None:
            missed = (decoded.numbers - frame.numbers).square()
            parts.append(self.config.numbers_weight * (missed.log1p() if tolerant else missed).sum(1))
        return torch.stack(parts).sum(0)

    def _decoded(self, state: Tensor) -> Frame:
        frame: Frame = self.decoder(state)
        return frame


def _leading(observations: Observations) -> tuple[int, ...]:
    """Segments and steps of streams (B, T, ...)."""
    return tuple(next(iter(observations.values())).shape[:2])


def _sign(x: Tensor, threshold: float) -> Tensor:
    """-1, 0 or 1, 0 where |x| is below the threshold."""
    return torch.where(x.abs() < threshold, torch.zeros_like(x), x.sign()).long()
