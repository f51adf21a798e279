"""What every subgoal generator offers."""

from typing import Protocol

import torch

from models.network import Network
from models.segments import Observations


class SubgoalGenerator(Network, Protocol):
    """p_phi(x_{t+1:t+K} | x_t), trained on action-free data only: the loss refuses a batch that carries actions."""

    def sample(self, observations: Observations, horizon: int, generator: torch.Generator) -> Observations:
        """Equation 4: observations x_t (B, ...) -> one chain each (B, K+1, ...), whose first element is x_t."""
        ...
