"""The gated recurrent unit of DreamerV3's state-space model."""

import torch
from torch import Tensor, nn

from models.networks.initialisation import linear
from models.networks.normalisation import LayerNorm


class NormalisedGruCell(nn.Module):
    """One layer norm over all three gates, which an update bias of -1 keeps closed at first:

    r, c, u = split(LN(W [x, h])),  h' = sigm(u - 1) tanh(sigm(r) c) + (1 - sigm(u - 1)) h
    """

    def __init__(self, inputs: int, size: int) -> None:
        super().__init__()
        self.layer = linear(inputs + size, 3 * size, bias=False)
        self.norm = LayerNorm(3 * size)

    def forward(self, x: Tensor, h: Tensor) -> Tensor:
        """x (B, inputs), h (B, size) -> h' (B, size)."""
        gates: Tensor = self.norm(self.layer(torch.cat((x, h), -1)))
        reset, candidate, update = gates.chunk(3, -1)
        proposed = torch.tanh(torch.sigmoid(reset) * candidate)
        return torch.lerp(h, proposed, torch.sigmoid(update - 1.0))
