"""Encoder and decoder of a robot's observations: camera images, and vectors of numbers."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks import image
from models.networks.initialisation import linear
from models.networks.mlp import NormalisedMlp
from models.networks.moments import Moments
from models.networks.symlog import symexp, symlog
from models.segments import Observations
from models.spaces import Spaces, bounded_box

FARTHEST = 10.0
"""Standard deviations that a number counts at most: what early data hardly moves is soon hundreds of them away, and
would outweigh all else in a loss or a distance."""


class Frame(NamedTuple):
    """Observations as networks read and write them; None where the spaces have no such stream.

    pixels: (..., S, S, 3 * cameras) in [0, 1]. numbers: (..., D), all vectors in a row, symlog, standardised.
    """

    pixels: Tensor | None
    numbers: Tensor | None

    def flat(self, lead: int) -> "Frame":
        """The first `lead` dimensions as one."""
        return Frame(*(None if part is None else part.flatten(0, lead - 1) for part in self))


@dataclass(frozen=True)
class ObservationNetworkConfig:
    """depth: channels of the largest feature map of an image. units, layers: of the perceptron that reads numbers."""

    depth: int = 32
    units: int = 1024
    layers: int = 5


def check_spaces(spaces: Spaces) -> None:
    """Raises ValueError, in a sentence, unless all streams are images or vectors of floats and actions are a box."""
    for name, stream in spaces.observations.items():
        vector = len(stream.shape) == 1 and stream.dtype.startswith("float")
        if not vector and len(stream.shape) != 3:
            found = f"{stream.dtype} {stream.shape}"
            raise ValueError(f"{name} must be an image, uint8 (S, S, {image.COLOURS}), or floats (D,), got {found}.")
    if not spaces.observations:
        raise ValueError("The robot family needs at least one observation stream, got none.")
    cameras = {name: stream for name, stream in spaces.observations.items() if len(stream.shape) == 3}
    if cameras:
        image.camera_size(cameras)
    bounded_box(spaces)


class Streams(nn.Module):
    """Which streams of the spaces are images and which are vectors, and the way from observations to frames and back.

    Streams are taken by name, in alphabetical order. Numbers are standardised by the moments of what `measure` saw:
    a loss in metres would not notice centimetres.
    """

    def __init__(self, spaces: Spaces, standardised: bool) -> None:
        super().__init__()
        check_spaces(spaces)
        streams = dict(sorted(spaces.observations.items()))
        self.cameras = tuple(name for name, stream in streams.items() if len(stream.shape) == 3)
        self.vectors = {name: stream.shape[0] for name, stream in streams.items() if len(stream.shape) == 1}
        self.size = image.camera_size({name: streams[name] for name in self.cameras}) if self.cameras else 0
        self.channels = image.COLOURS * len(self.cameras)
        self.numbers = sum(self.vectors.values())
        self.moments = Moments(self.numbers) if standardised and self.vectors else None

    def frame(self, observations: Observations) -> Frame:
        """Streams (..., of their shape) -> pixels and numbers (...)."""
        pixels = image.stacked(observations, self.cameras) if self.cameras else None
        if not self.vectors:
            return Frame(pixels, None)
        numbers = self._numbers(observations)
        if self.moments is not None:
            numbers = self.moments.standardised(numbers).clamp(-FARTHEST, FARTHEST)
        return Frame(pixels, numbers)

    def restored(self, frame: Frame) -> Observations:
        """The reverse of `frame`, images still float in [0, 1]."""
        streams: Observations = {} if frame.pixels is None else image.split(frame.pixels, self.cameras)
        if frame.numbers is not None:
            numbers = frame.numbers if self.moments is None else self.moments.restored(frame.numbers)
            parts = symexp(numbers).split(list(self.vectors.values()), -1)  # type: ignore[no-untyped-call]  # untyped in torch
            streams |= dict(zip(self.vectors, parts, strict=True))
        return streams

    def measure(self, observations: Observations) -> None:
        """Takes the vectors of observations into account."""
        if self.moments is not None:
            self.moments.update(self._numbers(observations).reshape(-1, self.numbers))

    def _numbers(self, observations: Observations) -> Tensor:
        return symlog(torch.cat([observations[name].float() for name in self.vectors], -1))


class ObservationEncoder(nn.Module):
    """Frames (N, ...) -> features (N, D), D = `outputs`: those of the images, then those of the numbers.

    The perceptron also reads a 1: layer norm after a product without bias would forget how large the numbers are.
    """

    def __init__(self, streams: Streams, config: ObservationNetworkConfig) -> None:
        super().__init__()
        self.image = image.ImageEncoder(streams.size, streams.channels, config.depth) if streams.cameras else None
        sizes = (streams.numbers + 1, *(config.units,) * config.layers)
        self.mlp = NormalisedMlp(sizes) if streams.vectors else None
        self.outputs = (self.image.outputs if self.image else 0) + (config.units if self.mlp else 0)

    def forward(self, frame: Frame) -> Tensor:
        features = []
        if self.image is not None:
            features.append(self.image(frame.pixels))
        if self.mlp is not None and frame.numbers is not None:
            features.append(self.mlp(F.pad(frame.numbers, (0, 1), value=1.0)))
        return torch.cat(features, -1)


class ObservationDecoder(nn.Module):
    """Features (N, inputs) -> frames (N, ...): means of the distribution over observations."""

    def __init__(self, inputs: int, streams: Streams, config: ObservationNetworkConfig) -> None:
        super().__init__()
        cameras, numbers, units = streams.cameras, streams.numbers, config.units
        self.image = image.ImageDecoder(inputs, streams.size, streams.channels, config.depth) if cameras else None
        self.mlp = NormalisedMlp((inputs, *(units,) * config.layers)) if numbers else None
        self.head = linear(units, numbers) if numbers else None

    def forward(self, features: Tensor) -> Frame:
        pixels = None if self.image is None else self.image(features)
        numbers = None if self.mlp is None or self.head is None else self.head(self.mlp(features))
        return Frame(pixels, numbers)
