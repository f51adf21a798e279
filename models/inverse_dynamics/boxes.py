"""Actions that are vectors in a box: how inverse dynamics says them, and how far it is from a label."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks.mlp import Mlp
from models.segments import SegmentBatch
from models.spaces import BoxAction, Spaces, bounded_box


class BoxHead(nn.Module):
    """Vectors (..., inputs) -> (..., D), one number a coordinate: the action before tanh, or the logit of a sign.

    Raises ValueError for spaces whose actions are no bounded box of vectors.
    """

    sign: Tensor

    def __init__(self, inputs: int, hidden: Sequence[int], spaces: Spaces) -> None:
        super().__init__()
        self.box = bounded_box(spaces)
        size = self.box.shape[0]
        self.mlp = Mlp((inputs, *hidden, size))
        sign = torch.zeros(size, dtype=torch.bool)
        sign[list(self.box.signs)] = True
        self.register_buffer("sign", sign, persistent=False)

    def forward(self, z: Tensor) -> Tensor:
        out: Tensor = self.mlp(z)
        return out

    def actions(self, out: Tensor) -> Tensor:
        """(..., D) in the box; one of its bounds where only the sign counts."""
        return self.box.restored(torch.where(self.sign, (out >= 0).to(out.dtype) * 2.0 - 1.0, out.tanh()))

    def error(self, out: Tensor, actions: Tensor) -> Tensor:
        """Sum over coordinates of the squared error in half boxes, or nats of a sign: (..., D) twice -> (...)."""
        unit = self.box.unit(actions)
        squared = (out.tanh() - unit).square()
        nats = F.softplus(torch.where(unit > 0, -out, out))
        return torch.where(self.sign, nats, squared).sum(-1)


def labels(batch: SegmentBatch) -> Tensor:
    """The actions (B, L, D). Raises ValueError for a batch without them."""
    if batch.actions is None:
        raise ValueError("Inverse dynamics trains on labeled segments; the batch carries no actions.")
    return batch.actions


def check_labels(batch: SegmentBatch, box: BoxAction) -> None:
    """Raises ValueError for actions that are not vectors in the box, naming the first such segment."""
    if batch.actions is None:
        return
    size = box.shape[0]
    if batch.actions.dim() != 3 or batch.actions.shape[2] != size:
        raise ValueError(f"actions must be (segments, steps, {size}), got {tuple(batch.actions.shape)}.")
    beyond = (batch.actions < box.low) | (batch.actions > box.high)
    outside = beyond.flatten(1).any(1).nonzero().flatten().tolist()
    if outside:
        raise ValueError(f"An action of {batch.name(outside[0])} is outside of [{box.low:g}, {box.high:g}].")
