"""Mean and deviation of what a network has been trained on so far, per coordinate."""

import torch
from torch import Tensor, nn

LEAST = 1e-3  # a coordinate that moves less is taken to be constant


class Moments(nn.Module):
    """Standardises rows (..., D) by all rows it was shown (Welford's update, a batch at a time).

    They are buffers: they travel with the weights, and resumed training goes on where it stopped.
    """

    count: Tensor
    mean: Tensor
    squares: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("squares", torch.zeros(size))  # sum of squared deviations from the mean

    @torch.no_grad()
    def update(self, rows: Tensor) -> None:
        """Takes rows (N, D) into account."""
        added, mean = len(rows), rows.mean(0)
        total = self.count + added
        step = mean - self.mean
        self.squares += (rows - mean).square().sum(0) + step.square() * (self.count * added / total)
        self.mean += step * (added / total)
        self.count.copy_(total)

    def standardised(self, rows: Tensor) -> Tensor:
        """(x - mean) / deviation."""
        return (rows - self.mean) / self._deviation()

    def restored(self, rows: Tensor) -> Tensor:
        """The inverse of `standardised`."""
        return rows * self._deviation() + self.mean

    def _deviation(self) -> Tensor:
        """(D,); 1 where nothing was shown yet."""
        deviation = (self.squares / self.count.clamp(min=1.0)).sqrt().clamp(min=LEAST)
        return torch.where(self.count > 0, deviation, torch.ones_like(deviation))
