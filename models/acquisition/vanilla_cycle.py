"""The cycle with dense inverse dynamics: what the mask M is worth."""

from dataclasses import dataclass

from models.acquisition.cycle import Cycle


@dataclass(frozen=True)
class VanillaCycle(Cycle):
    """L_cyc under the inverse dynamics that sees both whole frames."""

    name: str = "vanilla_cycle"
    inverse: str = "dense_inverse_dynamics"
