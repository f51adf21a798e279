"""What every strategy offers, the models it may ask for, and scoring of a whole pool."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

from models.inverse_dynamics.base import ActionProbabilities, InverseDynamics
from models.segments import SegmentBatch
from models.subgoal_generators.base import SubgoalGenerator
from models.world_models.base import WorldModel

CHUNK = 128  # segments a forward pass; larger ones leave the processor's cache
FIRST_ROUND_LACKS = frozenset({"previous_world_model"})
"""Networks that a strategy may need and a project's first round cannot have; the strategy says what it does then."""

Part = TypeVar("Part")


class NonFiniteScoreError(ValueError):
    """A score that is not finite; the message names its segment."""


@dataclass(frozen=True)
class Models:
    """The trained networks of a round, as far as it trained them, and the world model of the round before."""

    world_model: WorldModel | None = None
    inverse_dynamics: InverseDynamics | None = None
    dense_inverse_dynamics: InverseDynamics | None = None
    masked_inverse_dynamics: InverseDynamics | None = None
    subgoal_generator: SubgoalGenerator | None = None
    previous_world_model: WorldModel | None = None
    ensemble: tuple[WorldModel, ...] = ()


class Strategy(Protocol):
    """Scores segments; a higher score is a segment more worth labeling. Ranking is a step of its own: a batch rule.

    privileged: needs hidden actions (benchmarks only). needs: names of the fields of Models it reads.
    """

    @property
    def name(self) -> str: ...

    @property
    def privileged(self) -> bool: ...

    @property
    def needs(self) -> frozenset[str]: ...

    def actions(self, models: Models, batch: SegmentBatch) -> Tensor | None:
        """The actions (B, L) under which it looks at segments, for batch rules to compare them; None where it has none.

        So no arm's batch is diversified through another arm's networks.
        """
        ...

    def score(self, models: Models, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Scores (B,) of segments on the models' device, finite. Every draw comes from the generator."""
        ...


class InferredActions:
    """A strategy that looks at segments under the actions that the sparse inverse dynamics infers."""

    def actions(self: Strategy, models: Models, batch: SegmentBatch) -> Tensor:
        """The inferred ones: (B, L)."""
        return given(self, "inverse_dynamics", models.inverse_dynamics).infer(batch.observations)


@runtime_checkable
class PoolStrategy(Protocol):
    """A strategy whose scores depend on those of the whole pool."""

    def over_pool(self, scores: Tensor, generator: torch.Generator) -> Tensor:
        """The scores (N,) of all segments together, from what `score` gave each."""
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
    return strategy.over_pool(scores, generator) if isinstance(strategy, PoolStrategy) else scores


def require(strategy: Strategy, models: Models) -> None:
    """Raises ValueError naming the models that the strategy needs and `models` does not hold."""
    missing = sorted(name for name in strategy.needs - FIRST_ROUND_LACKS if not getattr(models, name))
    if missing:
        raise ValueError(f"Strategy {strategy.name} needs {', '.join(missing)}, which this round has not trained.")


@torch.inference_mode()
def confidence(strategy: Strategy, models: Models, batch: SegmentBatch, chunk: int = CHUNK) -> Tensor | None:
    """How sure the strategy's inverse dynamics is of the likeliest actions of segments, on the CPU: (B,) in (0, 1].

    The product over the steps. None where the strategy reads no inverse dynamics, or one that says no probabilities.
    """
    inverse = next(
        (getattr(models, name) for name in sorted(strategy.needs) if name.endswith("inverse_dynamics")), None
    )
    if not isinstance(inverse, ActionProbabilities):
        return None
    parts = [batch.take(slice(start, start + chunk)) for start in range(0, batch.size, chunk)]
    sure = [inverse.log_prob(part).amax(-1).sum(1).exp().clamp(max=1.0).cpu() for part in parts]
    return torch.cat(sure) if sure else torch.zeros(0)


def given(strategy: Strategy, name: str, part: Part | None) -> Part:
    """The part of the models that a strategy reads. Raises ValueError where it is missing."""
    if part is None:
        raise ValueError(f"Strategy {strategy.name} needs {name}, which this round has not trained.")
    return part


def labeled(strategy: Strategy, batch: SegmentBatch) -> SegmentBatch:
    """The batch, for a privileged strategy that looks at its hidden actions. Raises ValueError for an unlabeled one."""
    if batch.actions is None:
        raise ValueError(f"Strategy {strategy.name} is privileged: it needs the actions, which these segments lack.")
    return batch


def _require_finite(strategy: Strategy, scores: Tensor, batch: SegmentBatch) -> None:
    bad = torch.nonzero(~torch.isfinite(scores)).flatten().tolist()
    if bad:
        named = batch.segments[bad[0]] if batch.segments else f"row {bad[0]}"
        raise NonFiniteScoreError(
            f"Strategy {strategy.name} gave {float(scores[bad[0]])} to {named} ({len(bad)} of {len(scores)} scores)."
        )
