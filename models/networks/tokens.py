"""Frames as tokens: the patches of an image, all cameras in one, and each vector as one token."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from models.networks.initialisation import linear, table
from models.networks.observation import Streams


class Tokens(nn.Module):
    """Reads frames (B, T, ...) as tokens (B, T, N, D), and writes pixels and vectors back from such tokens.

    A token reads what it covers and how that differs from the frame before; of the first frame nothing is known to
    differ. Raises ValueError for images that patches do not cover.
    """

    def __init__(self, streams: Streams, width: int, patch: int) -> None:
        super().__init__()
        if streams.size % patch:
            raise ValueError(f"Images of {streams.size} pixels a side are not covered by patches of {patch}.")
        self.patch, self.side = patch, streams.size // patch
        sizes = [(self.side**2, patch**2 * streams.channels)] if streams.cameras else []
        sizes += [(1, size) for size in streams.vectors.values()]
        self.counts = [count for count, _ in sizes]
        self.read = nn.ModuleList(linear(2 * size, width) for _, size in sizes)
        self.place = table(sum(self.counts), width, 0.5)
        self.write = nn.ModuleList(linear(width, size) for _, size in sizes)

    def forward(self, values: Sequence[Tensor], changes: Sequence[Tensor]) -> Tensor:
        """Standardised pixels and vectors (B, T, ...) and their changes (B, T-1, ...) -> (B, T, N, D)."""
        tokens = []
        for value, change, read in zip(values, changes, self.read, strict=True):
            since = torch.cat((torch.zeros_like(value[:, :1]), change), 1)
            tokens.append(read(torch.cat((self._cut(value), self._cut(since)), -1)))
        return torch.cat(tokens, 2) + self.place

    def written(self, tokens: Tensor) -> list[Tensor]:
        """Tokens (B, T, N, D) -> pixels and vectors (B, T, ...)."""
        parts = tokens.split(self.counts, 2)  # type: ignore[no-untyped-call]  # untyped in torch
        rows = [write(part) for part, write in zip(parts, self.write, strict=True)]  # each (B, T, n, numbers)
        images = 1 if self.side else 0
        return [*map(self._joined, rows[:images]), *(row.squeeze(2) for row in rows[images:])]

    def _cut(self, part: Tensor) -> Tensor:
        """(B, T, S, S, C) -> (B, T, n, P*P*C), a vector (B, T, D) -> (B, T, 1, D)."""
        if part.dim() == 3:
            return part.unsqueeze(2)
        side, patch = self.side, self.patch
        rows = part.reshape(*part.shape[:2], side, patch, side, patch, part.shape[4])  # (B, T, n_r, P, n_c, P, C)
        return rows.transpose(3, 4).flatten(4).flatten(2, 3)

    def _joined(self, cut: Tensor) -> Tensor:
        """The reverse of an image."""
        side, patch = self.side, self.patch
        grid = cut.reshape(*cut.shape[:2], side, side, patch, patch, -1)  # (B, T, n_r, n_c, P, P, C)
        return grid.transpose(3, 4).flatten(4, 5).flatten(2, 3)  # (B, T, n_r, P, n_c, P, C) -> (B, T, S, S, C)
