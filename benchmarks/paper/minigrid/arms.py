"""Arms of the comparison: a strategy and the batch rule that makes its scores a batch."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.acquisition import BATCH_RULES, STRATEGIES, BatchRule, Models, Strategy
from models.acquisition.cycle import Cycle
from models.acquisition.random import Random
from models.segments import SegmentBatch

CONTROL, EXPLORE, CHANCE = "no_score", "explore", "explore_random"
EXPLORERS = (EXPLORE, CHANCE)
"""Arms in explore mode: what is labeled is executed by the labeler, not found in the pool."""


@dataclass(frozen=True)
class NoScore(Cycle):
    """A control: uniform scores, diversified in the latent space of `cycle`. What is diversity worth by itself?"""

    name: str = CONTROL

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """(B,), uniform on [0, 1)."""
        return torch.rand(batch.size, generator=generator)


@dataclass(frozen=True)
class Explore(Cycle):
    """`cycle` in explore mode."""

    name: str = EXPLORE

    @property
    def needs(self) -> frozenset[str]:
        """The cycle's networks and the subgoal generator."""
        return super().needs | {"subgoal_generator"}


ALL: dict[str, Strategy] = {**STRATEGIES, CONTROL: NoScore(), EXPLORE: Explore(), CHANCE: Random(CHANCE)}


@dataclass(frozen=True)
class Arm:
    """Written `strategy:rule`. Raises ValueError, naming what there is, for an unknown one."""

    strategy: str
    rule: str

    def __post_init__(self) -> None:
        for what, name, known in (("strategy", self.strategy, ALL), ("batch rule", self.rule, BATCH_RULES)):
            if name not in known:
                raise ValueError(f"{what} must be one of {', '.join(known)}, got {name!r}.")

    @classmethod
    def parse(cls, text: str) -> "Arm":
        """From `strategy:rule`."""
        strategy, _, rule = text.partition(":")
        return cls(strategy, rule)

    @property
    def name(self) -> str:
        """As it is written."""
        return f"{self.strategy}:{self.rule}"

    @property
    def scores(self) -> Strategy:
        """The strategy itself."""
        return ALL[self.strategy]

    @property
    def orders(self) -> BatchRule:
        """The batch rule itself."""
        return BATCH_RULES[self.rule]
