"""Open-loop errors: how far a world model's predictions are from what was observed, after one observation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from models.segments import SegmentBatch, first
from models.world_models.base import WorldModel

HORIZONS = (8, 32)


@dataclass(frozen=True)
class OpenLoopError:
    """Up to a horizon, by stream: squared errors of the world model, and of a prediction that nothing moves."""

    horizon: int
    errors: dict[str, float]
    standing_still: dict[str, float]

    @property
    def unforeseen(self) -> float | None:
        """Share of what changes that is not foreseen, mean over the streams that change; None where none does."""
        shares = [self.errors[name] / still for name, still in self.standing_still.items() if still > 0.0]
        return sum(shares) / len(shares) if shares else None


def open_loop(
    world_model: WorldModel, batch: SegmentBatch, after_each: Callable[[], None] = lambda: None
) -> tuple[OpenLoopError, ...]:
    """At those of HORIZONS that segments reach, and at their end. Raises ValueError for unlabeled segments."""
    horizons = sorted({horizon for horizon in HORIZONS if horizon < batch.length} | {batch.length})
    errors = open_loop_errors(world_model, batch, horizons, after_each=after_each)
    still = standing_still_errors(batch, horizons)
    return tuple(OpenLoopError(horizon, errors[horizon], still[horizon]) for horizon in horizons)


def standing_still_errors(batch: SegmentBatch, horizons: Sequence[int] = HORIZONS) -> dict[int, dict[str, float]]:
    """As `open_loop_errors`, of a prediction that all stays as it was first seen."""
    errors = {}
    for name, stream in batch.observations.items():  # (B, L+1, ...)
        steps = [_squared(stream[:, 0], stream[:, step]).double().mean() for step in range(1, batch.length + 1)]
        errors[name] = torch.stack(steps).cpu()
    return {horizon: {name: float(each[:horizon].mean()) for name, each in errors.items()} for horizon in horizons}


@torch.inference_mode()
def open_loop_errors(
    world_model: WorldModel,
    batch: SegmentBatch,
    horizons: Sequence[int] = HORIZONS,
    chunk: int = 32,
    after_each: Callable[[], None] = lambda: None,
) -> dict[int, dict[str, float]]:
    """Horizon -> stream -> squared error, mean over segments, over the steps up to the horizon and over coordinates.

    Images are in [0, 1], so theirs is the per-pixel error; numbers in their units, squared. The model sees the first
    observation and all actions. after_each: called after each chunk; may raise to stop. Raises ValueError for a batch
    without segments or actions, or of segments that are shorter than a horizon.
    """
    if batch.actions is None or batch.size == 0:
        found = "no segment" if batch.size == 0 else "no actions"
        raise ValueError(f"Open-loop errors need labeled segments; the batch carries {found}.")
    if batch.length < max(horizons):
        raise ValueError(f"Segments of {batch.length} steps are too short for a horizon of {max(horizons)}.")
    total = dict[str, Tensor]()
    for start in range(0, batch.size, chunk):
        for name, errors in step_errors(world_model, batch.take(slice(start, start + chunk))).items():
            total[name] = total.get(name, torch.zeros(())) + errors.sum(0).double().cpu()
        after_each()
    return {
        horizon: {name: float(errors[:horizon].mean()) / batch.size for name, errors in total.items()}
        for horizon in horizons
    }


def step_errors(world_model: WorldModel, batch: SegmentBatch) -> dict[str, Tensor]:
    """Of each segment, stream and step, mean over coordinates: (B, L), as in `open_loop_errors`.

    Raises ValueError for a batch without actions.
    """
    if batch.actions is None:
        raise ValueError("Open-loop errors need labeled segments; the batch carries no actions.")
    prediction = world_model.rollout(world_model.infer_state(first(batch.observations)), batch.actions)
    steps = []
    for step, state in enumerate(prediction.unbind(1), 1):  # one step's images at a time
        guess = world_model.observe(state)
        steps.append({name: _squared(guess[name], stream[:, step]) for name, stream in batch.observations.items()})
    return {name: torch.stack([each[name] for each in steps], 1) for name in batch.observations}


def _squared(guess: Tensor, truth: Tensor) -> Tensor:
    """(B, ...) twice -> (B,)."""
    scale = 1.0 if truth.is_floating_point() else 255.0
    return ((guess.float() - truth.float()) / scale).square().flatten(1).mean(1)
