"""What every strategy offers, the models it may ask for, and scoring of a whole pool."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from models.inverse_dynamics.base import InverseDynamics
from models.segments import SegmentBatch
from models.world_models.base import WorldModel

CHUNK = 128  # segments a forward pass; larger ones leave the processor's cache


class NonFiniteScoreError(ValueError):
    """A score that is not finite; the message names its segment."""


@dataclass(frozen=True)
class Models:
    """The trained networks of a round, as far as it trained them."""

    world_model: WorldModel | None = None
    inverse_dynamics: InverseDynamics | None = None
    dense_inverse_dynamics: InverseDynamics | None = None
    ensemble: tuple[WorldModel, ...] = ()


class Strategy(Protocol):
    """Scores segments; a higher score is a segment more worth labeling. Ranking is a step of its own.

    privileged: needs hidden actions (benchmarks only). needs: names of the fields of Models it reads.
    """

    @property
    def name(self) -> str: ...

    @property
    def privileged(self) -> bool: ...

    @property
    def needs(self) -> frozenset[str]: ...

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Scores (B,) of segments on the models' device, finite. Every draw comes from the generator."""
        ...


@torch.inference_mode()
def score_pool(
    strategy: Strategy,
    models: Models,
    batch: SegmentBatch,
    generator: torch.Generator,
    chunk: int = CHUNK,
    after_each: Callable[[], None] = lambda: None,
) -> Tensor:
    """Scores (B,) on the CPU of any number of segments, `chunk` at a time; after_each: called then, may raise to stop.

    Raises ValueError when `models` lacks what the strategy needs, NonFiniteScoreError naming the first segment.
    """
    require(strategy, models)
    parts: list[Tensor] = []
    for start in range(0, batch.size, chunk):
        parts.append(strategy.score(models, batch.take(slice(start, start + chunk)), generator))
        after_each()
    scores = torch.cat(parts).cpu() if parts else torch.zeros(0)
    _require_finite(strategy, scores, batch)
    return scores


def require(strategy: Strategy, models: Models) -> None:
    """Raises ValueError naming the models that the strategy needs and `models` does not hold."""
    missing = sorted(name for name in strategy.needs if not getattr(models, name))
    if missing:
        raise ValueError(f"Strategy {strategy.name} needs {', '.join(missing)}, which this round has not trained.")


def _require_finite(strategy: Strategy, scores: Tensor, batch: SegmentBatch) -> None:
    bad = torch.nonzero(~torch.isfinite(scores)).flatten().tolist()
    if bad:
        named = batch.segments[bad[0]] if batch.segments else f"row {bad[0]}"
        raise NonFiniteScoreError(
            f"Strategy {strategy.name} gave {float(scores[bad[0]])} to {named} ({len(bad)} of {len(scores)} scores)."
        )
