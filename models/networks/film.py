"""Residual dynamics modulated by a code through FiLM (Perez et al. 2018)."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks.coordinate_convolution import CoordinateConvolution
from models.networks.initialisation import linear


class FilmBlock(nn.Module):
    """z + W relu((1 + gamma) * conv(z) + beta): (B, H, W, C) -> (B, H, W, C)."""

    def __init__(self, channels: int, height: int, width: int) -> None:
        super().__init__()
        self.convolution = CoordinateConvolution(channels, channels, height, width)
        self.project = linear(channels, channels)

    def forward(self, z: Tensor, gamma: Tensor, beta: Tensor) -> Tensor:
        """gamma, beta: (B, 1, 1, C)."""
        h: Tensor = self.convolution(z)
        h = (h * (1.0 + gamma)).add_(beta).relu_()
        return F.linear(h, self.project.weight, self.project.bias).add_(z)


class FilmDynamics(nn.Module):
    """A stack of FiLM blocks; their parameters are linear in the code."""

    def __init__(self, code_size: int, channels: int, height: int, width: int, blocks: int) -> None:
        super().__init__()
        self.shape = (blocks, 2, 1, 1, channels)
        self.modulation = linear(code_size, blocks * 2 * channels)
        self.blocks = nn.ModuleList(FilmBlock(channels, height, width) for _ in range(blocks))

    @torch.no_grad()
    def weaken(self, factor: float) -> None:
        """Scales the modulation: at 0 every code does the same at the start (gamma = beta = 0)."""
        self.modulation.weight.mul_(factor)

    def parameters_of(self, codes: Tensor) -> Tensor:
        """FiLM parameters of codes: (N, code_size) -> (N, blocks, 2, 1, 1, C)."""
        film: Tensor = self.modulation(codes)
        return film.view(-1, *self.shape)

    def forward(self, z: Tensor, film: Tensor) -> Tensor:
        """z (B, H, W, C), film (B, blocks, 2, 1, 1, C) -> (B, H, W, C)."""
        for index, block in enumerate(self.blocks):
            z = block(z, film[:, index, 0], film[:, index, 1])
        return z
