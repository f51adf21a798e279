"""A policy's small convolutional encoder of one camera, and the shifts that it is trained under."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks.initialisation import convolution, linear

KERNEL, GROUPS = 5, 8
HALVINGS = 4
SHIFT = 4  # pixels


class CameraEncoder(nn.Module):
    """Four convolutions of stride 2 and a linear layer: uint8 (B, H, W, C) -> (B, size). H, W: multiples of 16."""

    def __init__(self, shape: Sequence[int], channels: int, size: int) -> None:
        super().__init__()
        height, width, colours = shape
        if height % 2**HALVINGS or width % 2**HALVINGS:
            raise ValueError(f"The sides of an image must be multiples of {2**HALVINGS}, got {height} x {width}.")
        widths = (colours, channels, 2 * channels, 2 * channels, 4 * channels)
        self.convolutions = nn.ModuleList(convolution(*two, KERNEL, stride=2) for two in pairwise(widths))
        self.project = linear(widths[-1] * (height >> HALVINGS) * (width >> HALVINGS), size)

    def forward(self, images: Tensor) -> Tensor:
        x = images.permute(0, 3, 1, 2).to(self.project.weight.dtype) / 127.5 - 1.0  # (B, H, W, C) -> (B, C, H, W)
        for layer in self.convolutions:
            x = F.mish(F.group_norm(layer(x), GROUPS))
        features: Tensor = self.project(x.flatten(1))
        return features


def shifted(images: Tensor, generator: torch.Generator) -> Tensor:
    """Images (B, T, H, W, C), the T of a row moved alike, by up to SHIFT pixels each way, with their border repeated
    (Yarats et al. 2021)."""
    rows, columns = (_places(len(images), side, generator).to(images.device) for side in images.shape[2:4])
    batch = torch.arange(len(images), device=images.device)[:, None, None]
    moved = images.transpose(1, 2).transpose(2, 3)[batch, rows[:, :, None], columns[:, None, :]]  # (B, H, W, T, C)
    return moved.permute(0, 3, 1, 2, 4)  # (B, H, W, T, C) -> (B, T, H, W, C)


def _places(count: int, side: int, generator: torch.Generator) -> Tensor:
    """(count, side): which pixel is seen at each place."""
    shift = torch.randint(-SHIFT, SHIFT + 1, (count, 1), generator=generator)
    return (torch.arange(side) + shift).clamp_(0, side - 1)
