"""Layer normalisation (Ba et al. 2016) before SiLU, as DreamerV3's networks have it throughout."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

EPSILON = 1e-3


class LayerNorm(nn.Module):
    """Over the last axis: (..., C) -> (..., C). `initialise` sets the gain to 1 and the bias to 0."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.empty(size))
        self.bias = nn.Parameter(torch.empty(size))

    def forward(self, x: Tensor) -> Tensor:
        return F.layer_norm(x, self.gain.shape, self.gain, self.bias, EPSILON)


class NormalisedSilu(nn.Module):
    """SiLU(LN(x)): (..., C) -> (..., C)."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.norm = LayerNorm(size)

    def forward(self, x: Tensor) -> Tensor:
        normalised: Tensor = self.norm(x)
        return F.silu(normalised)
