"""Pointer-generator heads (See et al. 2017, "Get to the point") over the elements of a grid world.

A soft element is a distribution of each channel: 22 numbers, object, colour and state one after the other.
"""

import torch
from torch import Tensor, nn

from models.networks import grid as cells

CHANNELS = len(cells.VOCABULARY)
GATES = 3  # keep, copy, write
LIMIT = 10.0  # of logits: beyond it gradients vanish into denormal floats, at which a CPU takes three times as long


class PointerGenerator(nn.Module):
    """p' = g_keep p + g_copy p_source + g_write p_new, with gates g and a distribution p_new from the head's outputs.

    Gates are a channel's own: a ball that changes its colour stays a ball. An object that moves is copied, so what is
    learned of a key also holds of a ball that no label has shown there.

    head: (..., C) -> (..., OUTPUTS). keep: added to the logit of the gate that keeps, since hardly anything changes.
    """

    OUTPUTS = cells.WORDS + GATES * CHANNELS

    def __init__(self, head: nn.Module, keep: float) -> None:
        super().__init__()
        self.head, self.keep = head, keep

    def forward(self, z: Tensor, now: Tensor, source: Tensor) -> Tensor:
        """z (B, N, C), soft elements now (22, B, N) and source (22, B, N or 1) -> soft elements (22, B, N).

        The vocabulary leads, so that a channel is a slice and a gate's weights (B, N) apply to all of its words.
        """
        out = LIMIT * (self.head(z).movedim(-1, 0) / LIMIT).tanh()
        written, gates = out[: cells.WORDS], out[cells.WORDS :]
        channels = (cells.split_heads(each) for each in (now, source, written))
        after = []
        for old, there, new, weights in zip(*channels, self._gates(gates), strict=True):
            keep, copy, write = weights  # each (B, N)
            after.append(torch.addcmul(torch.addcmul(keep * old, copy, there), write, new.softmax(0)))
        return torch.cat(after)

    def _gates(self, logits: Tensor) -> tuple[Tensor, ...]:
        """(9, B, N) -> a channel each, its weights (3, B, N)."""
        keep, copy, write = logits.chunk(GATES)
        weights: tuple[Tensor, ...] = torch.stack((keep + self.keep, copy, write)).softmax(0).unbind(1)
        return weights
