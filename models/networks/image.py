"""Convolutional encoder and decoder of camera images, in DreamerV3's form.

Strided convolutions halve the side and double the channels down to 4 x 4; transposed ones do the reverse. Images of one
moment are stacked on channels. Channels come last in every tensor, as images are stored: layer norms then run along
rows that lie contiguous in memory, and CPU convolutions are fastest in that layout.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks.initialisation import doubling_convolution, halving_convolution, linear
from models.networks.normalisation import NormalisedSilu
from models.segments import Observations
from models.spaces import StreamSpec

SMALLEST = 4  # side of the last feature map
COLOURS = 3


def camera_size(cameras: Mapping[str, StreamSpec]) -> int:
    """The side S of the cameras' images. Raises ValueError unless all are uint8 (S, S, 3) with S = 8, 16, 32, ..."""
    shapes = {stream.shape for stream in cameras.values()}
    size = next(iter(shapes))[0] if len(shapes) == 1 else 0
    powers = size > SMALLEST and size & (size - 1) == 0
    if not powers or shapes != {(size, size, COLOURS)} or any(stream.dtype != "uint8" for stream in cameras.values()):
        found = {name: f"{stream.dtype} {stream.shape}" for name, stream in cameras.items()}
        raise ValueError(f"Images must all be uint8 (S, S, {COLOURS}) with S one of 8, 16, 32, 64, ..., got {found}.")
    return size


def stacked(observations: Observations, cameras: Sequence[str]) -> Tensor:
    """All cameras' images of a moment: uint8 (..., S, S, 3) each -> float (..., S, S, 3 * cameras) in [0, 1]."""
    return torch.cat([observations[name] for name in cameras], -1).float().div_(255.0)


def split(pixels: Tensor, cameras: Sequence[str]) -> Observations:
    """The reverse of `stacked`, still float: (..., S, S, 3 * cameras) -> (..., S, S, 3) each."""
    return dict(zip(cameras, pixels.split(COLOURS, -1), strict=True))  # type: ignore[no-untyped-call]  # untyped in torch


def as_bytes(pixels: Tensor) -> Tensor:
    """Float pixels in [0, 1], or a little outside, as uint8."""
    return pixels.mul(255.0).round_().clamp_(0.0, 255.0).byte()


def _widths(size: int, depth: int) -> list[int]:
    """Channels of the feature maps, from half the image's side down to SMALLEST."""
    return [depth * 2**level for level in range((size // SMALLEST).bit_length() - 1)]


class ImageEncoder(nn.Module):
    """Pixels in [0, 1] (N, S, S, C) -> features (N, D), D = `outputs` = 16 * depth * S / 8."""

    def __init__(self, size: int, channels: int, depth: int) -> None:
        super().__init__()
        widths = _widths(size, depth)
        self.outputs = SMALLEST**2 * widths[-1]
        self.convolutions = nn.ModuleList(
            halving_convolution(before, after) for before, after in pairwise([channels, *widths])
        )
        self.norms = nn.ModuleList(NormalisedSilu(width) for width in widths)

    def forward(self, pixels: Tensor) -> Tensor:
        z = pixels - 0.5
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            h: Tensor = convolution(z.permute(0, 3, 1, 2))  # (N, H, W, C) -> (N, D, H/2, W/2), channels last in memory
            z = norm(h.permute(0, 2, 3, 1))
        return z.flatten(1)


class ImageDecoder(nn.Module):
    """Features (N, inputs) -> pixels (N, S, S, C), in [0, 1] where it is right: nothing bounds them."""

    def __init__(self, inputs: int, size: int, channels: int, depth: int) -> None:
        super().__init__()
        widths = _widths(size, depth)[::-1]
        self.project = linear(inputs, SMALLEST**2 * widths[0])
        self.convolutions = nn.ModuleList(doubling_convolution(before, after) for before, after in pairwise(widths))
        self.convolutions.append(doubling_convolution(widths[-1], channels, gain=0.1))  # begins with grey images
        self.norms = nn.ModuleList(NormalisedSilu(width) for width in widths[1:])
        self.bias = nn.Parameter(torch.empty(channels))

    def forward(self, features: Tensor) -> Tensor:
        h: Tensor = self.project(features)
        z = h.view(len(h), SMALLEST, SMALLEST, -1)
        for convolution, norm in zip(self.convolutions, [*self.norms, None], strict=True):
            up: Tensor = convolution(z.permute(0, 3, 1, 2))  # (N, H, W, C) -> (N, D, 2H, 2W), channels last in memory
            z = up.permute(0, 2, 3, 1)
            z = z if norm is None else norm(z)
        return z + (self.bias + 0.5)


def squared_error(pixels: Tensor, target: Tensor) -> Tensor:
    """Summed over the pixels of all cameras: (N, S, S, C) twice -> (N,)."""
    return F.mse_loss(pixels, target, reduction="none").flatten(1).sum(1)
