"""The cycle with the learned mask: what of M had to be known beforehand."""

from dataclasses import dataclass

from models.acquisition.cycle import Cycle


@dataclass(frozen=True)
class MaskedCycle(Cycle):
    """L_cyc under the inverse dynamics that learns which part of the frames to look at."""

    name: str = "masked_cycle"
    inverse: str = "masked_inverse_dynamics"
