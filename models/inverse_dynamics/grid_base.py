"""What all inverse dynamics of grid worlds have in common."""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from models.inverse_dynamics.elements import element_count
from models.networks import grid as cells
from models.networks.symmetry import every_turn
from models.segments import Observations, SegmentBatch
from models.spaces import Spaces


class GridInverseDynamics(nn.Module, ABC):
    """Infers the likeliest actions; how likely each is, and what is read for it, is each form's own."""

    family = "grid"
    spaces: Spaces

    @property
    def coordinates(self) -> int:
        """Elements of an observation: cells and the hand."""
        return element_count(self.spaces)

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for values outside the vocabulary."""
        cells.check(batch.observations)

    @abstractmethod
    def log_prob(self, batch: SegmentBatch) -> Tensor:
        """log p(a | x_t, x_{t+1}) for every action -> (B, L, n)."""

    def infer(self, observations: Observations) -> Tensor:
        """The most likely actions, int64 (B, L)."""
        return self.log_prob(SegmentBatch(observations)).argmax(-1)

    def views(self, batch: SegmentBatch) -> SegmentBatch:
        """The rooms in all four turns, in which training shows them."""
        return every_turn(batch)
