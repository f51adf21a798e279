"""A one-dimensional U-Net over time, conditioned through FiLM, as in diffusion policies (Chi et al. 2023)."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks.initialisation import linear, temporal_convolution, weak

KERNEL, GROUPS = 5, 8
FASTEST, SLOWEST = 1.0, 1e-4  # radians a noise step


def step_embedding(steps: Tensor, size: int, dtype: torch.dtype) -> Tensor:
    """Sines and cosines of noise steps, (B,) -> (B, size) (Vaswani et al. 2017)."""
    exponents = torch.linspace(math.log(FASTEST), math.log(SLOWEST), size // 2, dtype=dtype, device=steps.device)
    angles = steps[:, None].to(dtype) * exponents.exp()  # (B, size / 2)
    return torch.cat((angles.sin(), angles.cos()), 1)


class ConditionalBlock(nn.Module):
    """Two convolutions over time with FiLM between them and a path around them: (B, C, T) -> (B, C', T)."""

    def __init__(self, inputs: int, outputs: int, condition: int) -> None:
        super().__init__()
        self.first = temporal_convolution(inputs, outputs, KERNEL)
        self.second = temporal_convolution(outputs, outputs, KERNEL)
        self.around = temporal_convolution(inputs, outputs, 1)
        self.modulation = weak(linear(condition, 2 * outputs), 0.02)  # at the start any condition does the same

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """condition: (B, condition)."""
        gamma, beta = self.modulation(condition).unsqueeze(2).chunk(2, 1)  # (B, C', 1) each
        h = F.mish(F.group_norm(self.first(x), GROUPS)) * (1.0 + gamma) + beta
        h = F.mish(F.group_norm(self.second(h), GROUPS))
        around: Tensor = self.around(x)
        return h + around


class TemporalUnet(nn.Module):
    """Two levels, the lower one at half the rate with twice the channels: (B, T, D) -> (B, T, D), T even."""

    def __init__(self, size: int, channels: int, condition: int) -> None:
        super().__init__()
        self.size, wide = size, 2 * channels
        self.enter = ConditionalBlock(size, channels, condition)
        self.down = temporal_convolution(channels, channels, 3, stride=2)
        self.below = nn.ModuleList(
            (ConditionalBlock(channels, wide, condition), ConditionalBlock(wide, wide, condition))
        )
        self.up = temporal_convolution(wide, channels, 3)
        self.leave = ConditionalBlock(2 * channels, channels, condition)
        self.out = weak(temporal_convolution(channels, size, 1), 0.02)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """condition: (B, condition)."""
        condition = F.mish(condition)
        beside = self.enter(x.transpose(1, 2), condition)  # (B, T, D) -> (B, C, T)
        h = self.down(beside)  # (B, C, T / 2)
        for block in self.below:
            h = block(h, condition)
        h = self.up(F.interpolate(h, scale_factor=2.0))  # (B, 2C, T / 2) -> (B, C, T)
        h = self.leave(torch.cat((h, beside), 1), condition)
        out: Tensor = self.out(h)
        return out.transpose(1, 2)  # (B, D, T) -> (B, T, D)
