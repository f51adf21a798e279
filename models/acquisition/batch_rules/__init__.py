"""Batch rules: how scored candidates become a batch. Any strategy can use any of them; BATCH_RULES is the registry."""

from models.acquisition.batch_rules.base import BatchRule, Candidates, describe, top
from models.acquisition.batch_rules.k_center import KCenter
from models.acquisition.batch_rules.kmeans_plus_plus import KMeansPlusPlus
from models.acquisition.batch_rules.rank_noise import RankNoise
from models.acquisition.batch_rules.signatures import Signatures
from models.acquisition.batch_rules.top_n import Top

__all__ = ["BATCH_RULES", "BatchRule", "Candidates", "describe", "top"]

BATCH_RULES: dict[str, BatchRule] = {
    rule.name: rule for rule in (Top(), RankNoise(), KMeansPlusPlus(), KCenter(), Signatures())
}
