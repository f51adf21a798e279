"""Arms on robots: every strategy that takes actions of a box, and one that has the whole pool labeled."""

from dataclasses import dataclass

from api_schemas.strategies import DEFAULT_BATCH_RULE
from benchmarks.paper.minigrid.arms import Arm
from models.acquisition import STRATEGIES

EVERYTHING = "all"
REFUSING = ("forward_cycle", "self_inverse")  # they try every action
ALIKE = ("confident_cycle",)  # over a box it is `cycle`: the inverse dynamics says no probabilities
PLAIN = ("random",)  # looks at nothing, so every batch rule leaves its order alone


@dataclass(frozen=True)
class RobotArm:
    """A strategy and a batch rule; whole_pool: the first batch is all that there is, and nothing is left to choose."""

    arm: Arm
    whole_pool: bool = False

    @classmethod
    def parse(cls, text: str) -> "RobotArm":
        """From `strategy:rule`, `strategy` (by the default rule) or `all`. Raises ValueError for an unknown name."""
        if text == EVERYTHING:
            return cls(Arm("random", "top"), whole_pool=True)
        strategy, _, rule = text.partition(":")
        if strategy in REFUSING:
            raise ValueError(f"Strategy {strategy} tries every action, which a robot has too many of.")
        return cls(Arm(strategy, rule or ("top" if strategy in PLAIN else DEFAULT_BATCH_RULE)))

    @property
    def name(self) -> str:
        """As it is written."""
        return EVERYTHING if self.whole_pool else self.arm.name


RANDOM, DEFAULT, ORACLE = (RobotArm.parse(name) for name in ("random", "cycle", "oracle"))
FEW = ("random", "cycle", "vanilla_cycle", "oracle", EVERYTHING)
MANY = ("random", *(name for name in sorted(STRATEGIES) if name not in (*REFUSING, *ALIKE, *PLAIN)), EVERYTHING)
