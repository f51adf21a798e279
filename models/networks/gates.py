"""Hard-concrete gates (Louizos et al. 2018, "Learning sparse neural networks through L0 regularization").

A gate z in [0, 1] with logit log a is a stretched and clipped binary concrete variable, exactly 0 or 1 with positive
probability, so that the expected number of open gates has a gradient:

    u ~ U(0, 1),  s = sigm((log u - log(1 - u) + log a) / tau),  z = clip(s (zeta - gamma) + gamma, 0, 1)
    p(z > 0) = sigm(log a - tau log(-gamma / zeta))

A penalty on the gated values themselves could be escaped by scaling (small values, large weights after them); one on
the number of open gates cannot.
"""

import math

import torch
from torch import Tensor, nn

GAMMA, ZETA, TAU = -0.1, 1.1, 2.0 / 3.0


def sample_gates(logits: Tensor, generator: torch.Generator) -> Tensor:
    """z of each gate, in the shape of the logits log a; drawn on the generator's device."""
    uniform = torch.rand(logits.shape, generator=generator, device=generator.device).clamp_(1e-6, 1.0 - 1e-6)
    noise = (uniform.log() - torch.log1p(-uniform)).to(logits.device)
    return _stretched(torch.sigmoid((logits + noise) / TAU))


def inference_gates(logits: Tensor) -> Tensor:
    """z of each gate without chance: clip(sigm(log a) (zeta - gamma) + gamma, 0, 1)."""
    return _stretched(torch.sigmoid(logits))


def open_probability(logits: Tensor) -> Tensor:
    """p(z > 0) of each gate; its sum is the expected number of open gates, the L0 penalty."""
    return torch.sigmoid(logits - TAU * math.log(-GAMMA / ZETA))


def _stretched(s: Tensor) -> Tensor:
    return (s * (ZETA - GAMMA) + GAMMA).clamp(0.0, 1.0)


class PenaltyRamp(nn.Module):
    """The weight of a penalty over training: 0 for `free` losses, then linear, `full` from loss number `free + ramp`.

    A constant weight closes all gates before what they let through is of any use. The count is a buffer, so that it
    travels with the weights and resumed training goes on where it stopped.
    """

    losses: Tensor

    def __init__(self, full: float, free: int, ramp: int) -> None:
        super().__init__()
        self.full, self.free, self.ramp = full, free, max(1, ramp)
        self.register_buffer("losses", torch.zeros((), dtype=torch.int64))

    def forward(self) -> Tensor:
        """The weight of this loss; counts it."""
        share = (self.losses - self.free) / self.ramp
        self.losses += 1
        return self.full * share.clamp(0.0, 1.0)
