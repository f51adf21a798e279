"""What a batch rule is given of the candidates, and what it gives back."""

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from models.acquisition.base import CHUNK, Models, Strategy
from models.segments import SegmentBatch
from models.world_models.base import WorldModel

Description = Literal["features", "signatures"]


@dataclass(frozen=True)
class Candidates:
    """M scored segments, and where they differ, as far as the rule reads it and the strategy has networks to tell.

    scores (M,), finite. features (M, D): of what is predicted where the strategy's action acts. signatures int64
    (M, S): what happens in each, equal for equals. Raises ValueError for lengths that disagree.
    """

    scores: Tensor
    features: Tensor | None = None
    signatures: Tensor | None = None

    def __post_init__(self) -> None:
        for name, table in (("features", self.features), ("signatures", self.signatures)):
            if table is not None and (table.dim() != 2 or len(table) != len(self.scores)):
                expected = f"({len(self.scores)}, D) for {len(self.scores)} scores"
                raise ValueError(f"{name} must be {expected}, got {tuple(table.shape)}.")

    @property
    def count(self) -> int:
        """M."""
        return len(self.scores)

    def take(self, rows: Tensor) -> "Candidates":
        """Those of some rows, described as they were."""
        features, signatures = (None if table is None else table[rows] for table in (self.features, self.signatures))
        return Candidates(self.scores[rows], features, signatures)


class BatchRule(Protocol):
    """Orders scored candidates so that every prefix of the order is a good batch."""

    @property
    def name(self) -> str: ...

    @property
    def reads(self) -> Description | None:
        """Which description of the candidates it looks at; without it the rule is the plain order by score."""
        ...

    def order(self, candidates: Candidates, count: int, generator: torch.Generator) -> Tensor:
        """Indices of at most `count` candidates, int64, none twice, the best first."""
        ...


def top(scores: Tensor, count: int) -> Tensor:
    """Indices of the `count` highest scores (or all), highest first; equal scores keep their order."""
    return torch.sort(scores, descending=True, stable=True).indices[:count]


def weights(scores: Tensor) -> Tensor:
    """How much a candidate weighs: the square root of its score, in double precision; one below 0 weighs nothing."""
    return scores.double().clamp(min=0.0).sqrt()


def followed_by_rest(scores: Tensor, order: Tensor, count: int) -> Tensor:
    """The order, and after it all other candidates by score, `count` of them in all."""
    free = torch.ones(len(scores), dtype=torch.bool, device=scores.device)
    free[order] = False
    ranked = top(scores, len(scores))
    return torch.cat((order, ranked[free[ranked]]))[:count]


@torch.inference_mode()
def describe(
    rule: BatchRule, strategy: Strategy, models: Models, batch: SegmentBatch, scores: Tensor, chunk: int = CHUNK
) -> Candidates:
    """Scored segments with the description that the rule reads, on the CPU; without it where the strategy has no
    world model or looks at no actions."""
    needed = Models(**{name: getattr(models, name) for name in strategy.needs})  # no arm looks through another's eyes
    world_model = needed.world_model or next(iter(needed.ensemble), None)
    if rule.reads is None or world_model is None or batch.size == 0:
        return Candidates(scores)
    parts = []
    for start in range(0, batch.size, chunk):
        part = batch.take(slice(start, start + chunk))
        actions = strategy.actions(needed, part)
        if actions is None:
            return Candidates(scores)
        parts.append(description(rule.reads, world_model, part, actions))
    return Candidates(scores, **{rule.reads: torch.cat(parts).cpu()})


def description(reads: Description, world_model: WorldModel, batch: SegmentBatch, actions: Tensor) -> Tensor:
    """What a rule reads of segments, observed or imagined, under actions (B, L): a row each."""
    if reads == "signatures":
        return world_model.signatures(batch.observations, actions)
    return world_model.latent_features(batch.observations, actions)
