"""Space-time transformer: attention among the tokens of a frame, then of each token to its own past, in turns.

The factorised self-attention of ViViT (Arnab et al. 2021): T frames of N tokens cost T N^2 + N T^2 instead of (N T)^2.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks.initialisation import linear, table
from models.networks.mlp import Mlp


class SpaceTimeTransformer(nn.Module):
    """Tokens (B, T, N, D) -> (B, T, N, D). What comes out at a frame depends on it and on earlier frames alone.

    Time is told by how long ago a frame was, not by its place in the segment: a layer looks `context` frames back, so
    segments of any length are read alike.
    """

    def __init__(self, width: int, layers: int, heads: int, hidden: int, context: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(SpaceTimeBlock(width, heads, hidden, context) for _ in range(layers))

    def forward(self, x: Tensor) -> Tensor:
        for block in self.blocks:
            x = block(x)
        return normalised(x)


class SpaceTimeBlock(nn.Module):
    """Attention over space, attention over time, a perceptron, each added to what goes in (pre-norm).

    Raises ValueError for a width that the heads cannot share.
    """

    def __init__(self, width: int, heads: int, hidden: int, context: int) -> None:
        super().__init__()
        if width % heads:
            raise ValueError(f"width must be a multiple of heads, got {width} and {heads}.")
        self.space = Attention(width, heads)
        self.time = Attention(width, heads)
        self.past = PastBias(heads, context)
        self.perceptron = Mlp((width, hidden, width))

    def forward(self, x: Tensor) -> Tensor:
        batch, frames, tokens, _ = x.shape
        space = self.space(normalised(x).flatten(0, 1))  # (B, T, N, D) -> (B*T, N, D)
        x = x + space.view(x.shape)
        time = self.time(normalised(x).transpose(1, 2).flatten(0, 1), self.past(frames))  # -> (B*N, T, D)
        x = x + time.view(batch, tokens, frames, -1).transpose(1, 2)
        perceptron: Tensor = self.perceptron(normalised(x))
        return x + perceptron


class Attention(nn.Module):
    """Self-attention of several heads: (B, N, D), what is added to the scores (H, N, N) -> (B, N, D)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.project = linear(width, 3 * width)
        self.output = linear(width, width)

    def forward(self, x: Tensor, bias: Tensor | None = None) -> Tensor:
        projected = self.project(x).view(*x.shape[:2], 3, self.heads, -1)
        query, key, value = projected.permute(2, 0, 3, 1, 4)  # each (B, H, N, D/H)
        read = F.scaled_dot_product_attention(query, key, value, attn_mask=bias)
        out: Tensor = self.output(read.transpose(1, 2).flatten(2))  # (B, H, N, D/H) -> (B, N, D)
        return out


class PastBias(nn.Module):
    """What is added to a frame's scores of frames: a learned number by how long ago, -inf for what it may not see.

    What is -inf has no weight at all. A mask of ones and zeros that is added to the scores would make the future only a
    little less likely to be read.
    """

    def __init__(self, heads: int, context: int) -> None:
        super().__init__()
        self.lags = table(heads, context + 1, 0.02)

    def forward(self, frames: int) -> Tensor:
        """(H, T, T): a frame a row, what it looks at a column."""
        place = torch.arange(frames, device=self.lags.device)
        ago = place.unsqueeze(1) - place  # (T, T)
        context = self.lags.shape[1] - 1
        bias = self.lags[:, ago.clamp(0, context)]  # (H, T, T)
        return bias.masked_fill((ago < 0) | (ago > context), -torch.inf)


def normalised(x: Tensor) -> Tensor:
    """Layer norm over the last axis: every token by itself, so that none tells another how large it is.

    Without gain and bias, which the linear layer that follows each norm has itself.
    """
    return F.layer_norm(x, x.shape[-1:])
