"""A diffusion policy (Chi et al. 2023): a chunk of actions is denoised under what was observed last."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks.initialisation import initialise
from models.networks.mlp import Mlp
from models.networks.temporal_unet import TemporalUnet, step_embedding
from models.policies.camera_encoder import CameraEncoder, shifted
from models.policies.noise import acting_scheduler, training_scheduler
from models.segments import Observations, SegmentBatch
from models.spaces import BoxAction, Spaces
from models.training import TrainingConfig

HISTORY = 2  # observations: a pose and how it moved
FARTHEST = 5.0  # standard deviations of the demonstrations; what lies beyond is unlike them, however far
LEAST = 1e-2  # m or entry of a rotation matrix: numbers that differ less count as one


@dataclass(frozen=True)
class DiffusionPolicyConfig:
    """`chunk` actions are predicted at once; the first `executed` of them are meant to be taken.

    Noise is added in `noise_steps` steps and taken away in `acting_steps`; the network predicts the noise ("epsilon")
    or the actions ("sample").
    """

    chunk: int = 16
    executed: int = 4
    channels: int = 32
    features: int = 128
    image_channels: int = 16
    embedding: int = 32  # of the noise step
    noise_steps: int = 100
    acting_steps: int = 10
    prediction: Literal["epsilon", "sample"] = "sample"

    def __post_init__(self) -> None:
        if self.chunk < 2 or self.chunk % 2:
            raise ValueError(f"chunk must be even and at least 2, got {self.chunk}.")
        if not 1 <= self.executed <= self.chunk:
            raise ValueError(f"executed must be from 1 to chunk ({self.chunk}), got {self.executed}.")


def training_config(spaces: Spaces) -> TrainingConfig:
    """The default schedule, the same for every task: minutes on one thread of a processor, also where there are images,
    a step of which takes ten times as long."""
    has_images = any(len(stream.shape) == 3 for stream in spaces.observations.values())
    steps, batch_size = (1500, 64) if has_images else (3000, 128)
    return TrainingConfig(steps=steps, batch_size=batch_size, learning_rate=1e-3, weight_decay=1e-4)


class DiffusionPolicy(nn.Module):
    """p(a_t, ..., a_{t+chunk-1} | x_{t-1}, x_t), actions in a box from -1 to 1.

    A segment that it learns from is one transition x_{t-1}, x_t with the whole chunk in the place of an action: actions
    (B, 1, chunk, D). Streams (H, W, C) are images, (N,) vectors; the statistics that vectors are normalised by belong
    to the weights.
    """

    family = "diffusion"
    kind = "policy"
    mean: Tensor
    deviation: Tensor

    def __init__(self, spaces: Spaces, config: DiffusionPolicyConfig, generator: torch.Generator) -> None:
        super().__init__()
        if not isinstance(spaces.action, BoxAction) or len(spaces.action.shape) != 1:
            raise ValueError(f"A diffusion policy takes actions that are vectors of a box, got {spaces.action}.")
        self.spaces, self.config = spaces, config
        streams = spaces.observations
        self.images = [name for name in sorted(streams) if len(streams[name].shape) == 3]
        self.vectors = [name for name in sorted(streams) if len(streams[name].shape) == 1]
        numbers = sum(streams[name].shape[0] for name in self.vectors)
        self.register_buffer("mean", torch.zeros(numbers))
        self.register_buffer("deviation", torch.ones(numbers))
        self.encoders = nn.ModuleDict(
            {name: CameraEncoder(streams[name].shape, config.image_channels, config.features) for name in self.images}
        )
        inputs = HISTORY * (numbers + len(self.images) * config.features)
        self.mix = Mlp((inputs, 2 * config.features, config.features))
        self.unet = TemporalUnet(spaces.action.shape[0], config.channels, config.features + config.embedding)
        initialise(self, generator)

    @torch.no_grad()
    def fit_statistics(self, batch: SegmentBatch) -> None:
        """Takes over mean and standard deviation of the vectors of segments, before training on them."""
        numbers = self._numbers(batch.observations).flatten(0, 1)  # (B, 2, N) -> (2B, N)
        self.mean.copy_(numbers.mean(0))
        self.deviation.copy_(numbers.std(0).clamp_min(LEAST))

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for segments without chunks of actions from -1 to 1, or with a number that is none."""
        expected = (batch.size, 1, self.config.chunk, self.actions)
        found = None if batch.actions is None else tuple(batch.actions.shape)
        if batch.actions is None or found != expected:
            raise ValueError(f"actions must have the shape (segments, 1, chunk, numbers) = {expected}, got {found}.")
        if not bool((batch.actions.abs() <= 1).all()):
            raise ValueError("actions must lie between -1 and 1.")
        for name in self.vectors:
            if not bool(batch.observations[name].isfinite().all()):
                raise ValueError(f"{name} must hold finite numbers only.")

    @property
    def actions(self) -> int:
        """Numbers in an action, D."""
        return int(self.unet.size)

    def encode(self, observations: Observations) -> Tensor:
        """What was observed last, (B, 2, ...) -> (B, features)."""
        numbers = (self._numbers(observations) - self.mean) / self.deviation
        parts = [numbers.clamp(-FARTHEST, FARTHEST).flatten(1)]  # (B, 2, N) -> (B, 2N)
        for name in self.images:
            seen = self.encoders[name](observations[name].flatten(0, 1))  # (B, 2, H, W, C) -> (2B, features)
            parts.append(seen.unflatten(0, (-1, HISTORY)).flatten(1))
        features: Tensor = self.mix(torch.cat(parts, 1))
        return features

    def predict(self, noisy: Tensor, steps: Tensor, features: Tensor) -> Tensor:
        """The noise in (B, chunk, D) after so many noise steps (B,), or the actions: see the config."""
        embedded = step_embedding(steps, self.config.embedding, features.dtype)
        predicted: Tensor = self.unet(noisy, torch.cat((features, embedded), 1))
        return predicted

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Mean squared error of the noise (or the actions) at noise steps drawn uniformly (Ho et al. 2020, eq. 14)."""
        if batch.actions is None:
            raise ValueError("A policy learns from segments with actions; the batch carries none.")
        actions = batch.actions[:, 0]  # (B, 1, chunk, D) -> (B, chunk, D)
        noise = torch.randn(actions.shape, generator=generator).to(actions)
        steps = torch.randint(self.config.noise_steps, (batch.size,), generator=generator).to(actions.device)
        noisy = training_scheduler(self.config.noise_steps, self.config.prediction).add_noise(actions, noise, steps)
        seen = {
            name: shifted(stream, generator) if name in self.images else stream
            for name, stream in batch.observations.items()
        }
        target = noise if self.config.prediction == "epsilon" else actions
        return F.mse_loss(self.predict(noisy, steps, self.encode(seen)), target)

    @torch.no_grad()
    def sample(self, observations: Observations, generator: torch.Generator) -> Tensor:
        """Chunks of actions, (B, 2, ...) -> (B, chunk, D); chance is in the noise that they are made of."""
        features, config = self.encode(observations), self.config
        chunk = torch.randn(len(features), config.chunk, self.actions, generator=generator).to(features)
        scheduler = acting_scheduler(config.noise_steps, config.acting_steps, config.prediction)
        for step in scheduler.timesteps:
            predicted = self.predict(chunk, step.expand(len(chunk)), features)
            chunk = scheduler.step(predicted, step, chunk).prev_sample
        return chunk.clamp(-1.0, 1.0)

    def _numbers(self, observations: Observations) -> Tensor:
        """(B, 2, N): all vectors of each observation."""
        return torch.cat([observations[name].to(self.mean.dtype) for name in self.vectors], 2)
