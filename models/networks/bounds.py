"""The smallest and largest of what a network has been trained on so far, per coordinate."""

import torch
from torch import Tensor, nn


class Bounds(nn.Module):
    """Holds rows (..., D) within all rows it was shown; before any, it lets all pass. Buffers, as moments are."""

    lowest: Tensor
    highest: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("lowest", torch.full((size,), torch.inf))
        self.register_buffer("highest", torch.full((size,), -torch.inf))

    @torch.no_grad()
    def update(self, rows: Tensor) -> None:
        """Takes rows (N, D) into account."""
        self.lowest.copy_(torch.minimum(self.lowest, rows.amin(0)))
        self.highest.copy_(torch.maximum(self.highest, rows.amax(0)))

    def forward(self, rows: Tensor) -> Tensor:
        shown = self.lowest <= self.highest
        return torch.where(shown, rows.clamp(self.lowest, self.highest), rows)
