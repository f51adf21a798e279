"""The method: cycle error of the observed future under the sparse inverse dynamics."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition.base import Models, given
from models.cycle_consistency import cycle_error
from models.inverse_dynamics.base import InverseDynamics
from models.segments import SegmentBatch


@dataclass(frozen=True)
class Cycle:
    """L_cyc of a segment with its own observed future as the chain.

    inverse: the field of Models whose inverse dynamics infers; the sparse one, its learned mask and the dense one make
    three arms.
    """

    name: str = "cycle"
    inverse: str = "inverse_dynamics"
    privileged: bool = False

    @property
    def needs(self) -> frozenset[str]:
        """The world model and the inverse dynamics."""
        return frozenset({"world_model", self.inverse})

    def actions(self, models: Models, batch: SegmentBatch) -> Tensor:
        """The inferred ones."""
        return self.verifier(models).infer(batch.observations)

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,) in the world model's distance. Draws nothing from the generator."""
        world_model = given(self, "world_model", models.world_model)
        return cycle_error(world_model, self.verifier(models), batch.observations)

    def verifier(self, models: Models) -> InverseDynamics:
        """Whose inverse dynamics infers. Raises ValueError where the round has not trained it."""
        trained: InverseDynamics | None = getattr(models, self.inverse)
        return given(self, self.inverse, trained)
