"""A frame as a vector: the numbers of its vectors as they are, and a latent of its images."""

import torch
from torch import Tensor, nn

from models.networks.image import ImageDecoder, ImageEncoder
from models.networks.initialisation import linear
from models.networks.moments import Moments
from models.networks.observation import Frame, Streams
from models.networks.space_time_transformer import normalised
from models.segments import Observations
from models.spaces import Spaces


class FrameCoordinates(nn.Module):
    """Observations (B, T, ...) -> coordinates (B, T, C): numbers, standardised, then the images' latent.

    The latent has mean 0 and deviation 1 over its own coordinates, so that none of it can shrink or grow away. Images
    are read back from all coordinates: what the numbers tell already, the latent need not. Without images there is
    nothing to learn here but moments. latent: numbers of it; depth: channels of the largest feature map.
    """

    def __init__(self, spaces: Spaces, latent: int, depth: int) -> None:
        super().__init__()
        self.streams = Streams(spaces, standardised=True)
        size, channels, cameras = self.streams.size, self.streams.channels, self.streams.cameras
        self.size = self.streams.numbers + (latent if cameras else 0)
        self.encoder = ImageEncoder(size, channels, depth) if cameras else None
        self.project = linear(self.encoder.outputs, latent) if self.encoder else None
        self.decoder = ImageDecoder(self.size, size, channels, depth) if cameras else None
        self.pixels = Moments(1)

    def measure(self, observations: Observations) -> None:
        """Takes observations into account."""
        self.streams.measure(observations)
        frame = self.streams.frame(observations)
        if frame.pixels is not None:
            self.pixels.update(frame.pixels.reshape(-1, 1))

    def forward(self, observations: Observations) -> Tensor:
        frame = self.streams.frame(observations)
        parts = [] if frame.numbers is None else [frame.numbers]
        if frame.pixels is not None and self.encoder is not None and self.project is not None:
            features = self.encoder(frame.pixels.flatten(0, 1))  # (B, T, S, S, C) -> (B*T, F)
            parts.append(normalised(self.project(features)).view(*frame.pixels.shape[:2], -1))
        return torch.cat(parts, -1)

    def settled(self, coordinates: Tensor) -> Tensor:
        """Coordinates (..., C) whose latent has mean 0 and deviation 1 again, as that of every image has."""
        if self.decoder is None:
            return coordinates
        numbers, latent = coordinates.tensor_split([self.streams.numbers], -1)
        return torch.cat((numbers, normalised(latent)), -1)

    def decode(self, coordinates: Tensor) -> Frame:
        """(N, C) -> frames (N, ...)."""
        numbers = coordinates[:, : self.streams.numbers] if self.streams.vectors else None
        return Frame(None if self.decoder is None else self.decoder(coordinates), numbers)

    def error(self, coordinates: Tensor, observations: Observations) -> Tensor:
        """Squared error of the images read back, in variances of a pixel, mean over all: (B, T, C), (B, T, ...) -> ().

        0 where there are none.
        """
        pixels = self.streams.frame(observations).pixels
        read = self.decode(coordinates.flatten(0, 1)).pixels
        if pixels is None or read is None:
            return coordinates.new_zeros(())
        seen = self.pixels.standardised(pixels.flatten(0, 1))
        return (self.pixels.standardised(read) - seen).square().mean()
