"""Vector quantisation (van den Oord et al. 2017) with supervised codes."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.networks.initialisation import table


class SupervisedCodebook(nn.Module):
    """One embedding E[a] and one code C[a] an action; E[a] is replaced by its nearest code.

    Works on the table of all actions at once, (n, code_size): a batch only indexes what was computed here.
    """

    def __init__(self, actions: int, code_size: int, commitment: float = 0.25, supervision: float = 0.1) -> None:
        super().__init__()
        self.commitment, self.supervision = commitment, supervision
        self.embeddings = table(actions, code_size)
        self.codes = table(actions, code_size)

    def forward(self) -> Tensor:
        """Quantised codes of all actions (n, code_size); the gradient passes straight through to the embeddings."""
        nearest = self.codes[torch.cdist(self.embeddings, self.codes).argmin(1)]
        return self.embeddings + (nearest - self.embeddings).detach()

    def loss(self) -> Tensor:
        """supervision * CE(-|E - C|^2, own code) + |sg E - C|^2 + commitment * |E - sg C|^2, mean over actions."""
        distances = torch.cdist(self.embeddings, self.codes, compute_mode="donot_use_mm_for_euclid_dist").square()
        own = torch.arange(len(distances), device=distances.device)
        nearest = self.codes[distances.argmin(1)]
        codebook = F.mse_loss(nearest, self.embeddings.detach())
        commitment = F.mse_loss(self.embeddings, nearest.detach())
        return self.supervision * F.cross_entropy(-distances, own) + codebook + self.commitment * commitment
