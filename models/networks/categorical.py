"""Independent categorical variables, G groups of C classes, as codes of G one-hot vectors (Hafner et al. 2023)."""

import torch
from torch import Tensor


def probabilities(logits: Tensor, unimix: float) -> Tensor:
    """(1 - unimix) softmax + unimix / C: (..., G, C) -> (..., G, C). No class is impossible, no divergence endless."""
    return torch.softmax(logits, -1) * (1.0 - unimix) + unimix / logits.shape[-1]


def mode(probability: Tensor) -> Tensor:
    """The likeliest class of each group, one-hot: (..., G, C) -> (..., G, C)."""
    return _one_hot(probability.argmax(-1, keepdim=True), probability)


def straight_through_sample(probability: Tensor, uniform: Tensor) -> Tensor:
    """z = onehot + p - sg(p): a draw, whose gradient is that of p: (..., G, C), uniform (..., G) in [0, 1).

    The class is the one whose share of the cumulated probabilities holds the uniform number.
    """
    with torch.no_grad():
        below = probability.cumsum(-1) <= uniform.unsqueeze(-1)  # (..., G, C)
        drawn = below.sum(-1, keepdim=True).clamp_(max=probability.shape[-1] - 1)  # rounding: the sum may be below 1
    return _one_hot(drawn, probability) + (probability - probability.detach())


def kl_divergence(p: Tensor, q: Tensor) -> Tensor:
    """KL(p || q) summed over the groups: (..., G, C) twice -> (...) nats. No probability may be 0."""
    return (p * (p.log() - q.log())).sum((-2, -1))


def _one_hot(classes: Tensor, like: Tensor) -> Tensor:
    return torch.zeros_like(like).scatter_(-1, classes, 1.0)
