"""Multilayer perceptrons."""

from collections.abc import Sequence
from itertools import pairwise

from torch import Tensor, nn

from models.networks.initialisation import linear
from models.networks.normalisation import NormalisedSilu


class Mlp(nn.Module):
    """Linear layers of the given sizes with ReLU between them: (..., sizes[0]) -> (..., sizes[-1])."""

    def __init__(self, sizes: Sequence[int]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(linear(inputs, outputs) for inputs, outputs in pairwise(sizes))

    def forward(self, x: Tensor) -> Tensor:
        for index, layer in enumerate(self.layers):
            x = layer(x.relu() if index else x)
        return x


class NormalisedMlp(nn.Module):
    """DreamerV3's layers SiLU(LN(W x)), W without bias: (..., sizes[0]) -> (..., sizes[-1])."""

    def __init__(self, sizes: Sequence[int]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(linear(inputs, outputs, bias=False) for inputs, outputs in pairwise(sizes))
        self.norms = nn.ModuleList(NormalisedSilu(size) for size in sizes[1:])

    def forward(self, x: Tensor) -> Tensor:
        for layer, norm in zip(self.layers, self.norms, strict=True):
            x = norm(layer(x))
        return x
