"""Strategies: which segments to have labeled next. STRATEGIES is the only registry."""

from models.acquisition.base import Models, NonFiniteScoreError, Strategy, confidence, score_pool
from models.acquisition.batch_rules import BATCH_RULES, BatchRule, Candidates, describe, top
from models.acquisition.confident_cycle import ConfidentCycle
from models.acquisition.cycle import Cycle
from models.acquisition.fidelity import Fidelity
from models.acquisition.forward_cycle import ForwardCycle
from models.acquisition.masked_cycle import MaskedCycle
from models.acquisition.oracle import Oracle
from models.acquisition.oracle_easy import OracleEasy
from models.acquisition.oracle_uniform import OracleUniform
from models.acquisition.progress import Progress, TrueProgress
from models.acquisition.random import Random
from models.acquisition.reachability import Reachability
from models.acquisition.self_inverse import SelfInverse
from models.acquisition.uncertainty import Uncertainty
from models.acquisition.vanilla_cycle import VanillaCycle

__all__ = [
    "BATCH_RULES",
    "EXPLORING",
    "STRATEGIES",
    "BatchRule",
    "Candidates",
    "Cycle",
    "Models",
    "NonFiniteScoreError",
    "Strategy",
    "confidence",
    "describe",
    "score_pool",
    "top",
]

_ALL: tuple[Strategy, ...] = (
    Random(),
    Cycle(),
    ConfidentCycle(),
    MaskedCycle(),
    VanillaCycle(),
    SelfInverse(),
    Uncertainty(),
    Progress(),
    Fidelity(),
    Reachability(),
    ForwardCycle(),
    TrueProgress(),
    Oracle(),
    OracleEasy(),
    OracleUniform(),
)
STRATEGIES: dict[str, Strategy] = {strategy.name: strategy for strategy in _ALL}
EXPLORING: dict[str, Cycle] = {
    **{strategy.name: strategy for strategy in _ALL if isinstance(strategy, Cycle)},
    "confident_cycle": Cycle("confident_cycle"),  # explore mode filters by confidence as it is
}
"""Those that propose what to execute, and whose inverse dynamics infers the actions of imagined futures."""
