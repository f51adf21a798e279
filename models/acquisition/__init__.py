"""Strategies: which segments to have labeled next. STRATEGIES is the only registry."""

from models.acquisition.base import Models, NonFiniteScoreError, Strategy, score_pool
from models.acquisition.cycle import Cycle
from models.acquisition.diversification import CANDIDATES_PER_PICK, diversify, features, top
from models.acquisition.random import Random
from models.acquisition.uncertainty import Uncertainty
from models.acquisition.vanilla_cycle import VanillaCycle

__all__ = [
    "CANDIDATES_PER_PICK",
    "STRATEGIES",
    "Models",
    "NonFiniteScoreError",
    "Strategy",
    "diversify",
    "features",
    "score_pool",
    "top",
]

STRATEGIES: dict[str, Strategy] = {
    strategy.name: strategy for strategy in (Random(), Cycle(), VanillaCycle(), Uncertainty())
}
