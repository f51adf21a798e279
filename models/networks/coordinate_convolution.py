"""Coordinate convolution (Liu et al. 2018, "An intriguing failing of convolutional neural networks")."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks.initialisation import convolution


class CoordinateConvolution(nn.Module):
    """A same-size convolution that also reads each cell's normalised (x, y): (B, H, W, C) -> (B, H, W, D).

    Concatenating two constant channels and convolving is the sum of two convolutions, and the one over the
    coordinates does not depend on the input; so it is computed once a call for one image and added.
    Tensors keep the channel last, which is also the fastest layout of 3x3 convolutions on CPUs.
    """

    coordinates: Tensor

    def __init__(self, inputs: int, outputs: int, height: int, width: int, kernel: int = 3) -> None:
        super().__init__()
        self.convolution = convolution(inputs, outputs, kernel)
        self.position = convolution(2, outputs, kernel)
        rows = torch.linspace(-1.0, 1.0, height).view(height, 1).expand(height, width)
        columns = torch.linspace(-1.0, 1.0, width).view(1, width).expand(height, width)
        self.register_buffer("coordinates", torch.stack((columns, rows)).unsqueeze(0), persistent=False)

    def forward(self, z: Tensor) -> Tensor:
        position: Tensor = self.position(self.coordinates).permute(0, 2, 3, 1)  # (1, D, H, W) -> (1, H, W, D)
        weight, padding = self.convolution.weight, self.convolution.padding
        weight = weight.contiguous(memory_format=torch.channels_last)
        h = F.conv2d(z.permute(0, 3, 1, 2), weight, self.convolution.bias, padding=padding)
        return h.permute(0, 2, 3, 1).add_(position)  # (B, D, H, W) -> (B, H, W, D)
