"""Actions that are vectors in [-1, 1]: how inverse dynamics says them, and how far it is from a label."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks.mlp import Mlp
from models.segments import SegmentBatch
from models.spaces import BoxAction, Spaces


class BoxHead(nn.Module):
    """Vectors (..., inputs) -> (..., D), one number a coordinate: the action before tanh, or the logit of a sign.

    signs: coordinates of an action of which only the sign counts, as a gripper's; they may count from the end. Raises
    ValueError for spaces whose actions are no box from -1 to 1, or one without such coordinates.
    """

    sign: Tensor

    def __init__(self, inputs: int, hidden: Sequence[int], spaces: Spaces, signs: Sequence[int]) -> None:
        super().__init__()
        size = box_size(spaces)
        if any(not -size <= place < size for place in signs):
            raise ValueError(f"signs must be places in an action of {size} numbers, got {tuple(signs)}.")
        self.mlp = Mlp((inputs, *hidden, size))
        sign = torch.zeros(size, dtype=torch.bool)
        sign[list(signs)] = True
        self.register_buffer("sign", sign, persistent=False)

    def forward(self, z: Tensor) -> Tensor:
        out: Tensor = self.mlp(z)
        return out

    def actions(self, out: Tensor) -> Tensor:
        """(..., D) in [-1, 1]; -1 or 1 where only the sign counts."""
        return torch.where(self.sign, (out >= 0).to(out.dtype) * 2.0 - 1.0, out.tanh())

    def error(self, out: Tensor, actions: Tensor) -> Tensor:
        """Sum over coordinates of the squared error, or nats of a sign: (..., D) twice -> (...)."""
        squared = (out.tanh() - actions).square()
        nats = F.softplus(torch.where(actions > 0, -out, out))
        return torch.where(self.sign, nats, squared).sum(-1)


def box_size(spaces: Spaces) -> int:
    """Numbers of an action. Raises ValueError unless actions are vectors from -1 to 1."""
    action = spaces.action
    if not isinstance(action, BoxAction) or len(action.shape) != 1 or (action.low, action.high) != (-1.0, 1.0):
        raise ValueError(f"This inverse dynamics needs actions that are vectors from -1 to 1, got {action}.")
    return action.shape[0]


def labels(batch: SegmentBatch) -> Tensor:
    """The actions (B, L, D). Raises ValueError for a batch without them."""
    if batch.actions is None:
        raise ValueError("Inverse dynamics trains on labeled segments; the batch carries no actions.")
    return batch.actions


def check_labels(batch: SegmentBatch, size: int) -> None:
    """Raises ValueError for actions that are not `size` numbers from -1 to 1, naming the first such segment."""
    if batch.actions is None:
        return
    if batch.actions.dim() != 3 or batch.actions.shape[2] != size:
        raise ValueError(f"actions must be (segments, steps, {size}), got {tuple(batch.actions.shape)}.")
    outside = (batch.actions.abs() > 1.0).flatten(1).any(1).nonzero().flatten().tolist()
    if outside:
        raise ValueError(f"An action of {batch.name(outside[0])} is outside of [-1, 1].")
