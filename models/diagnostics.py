"""Diagnostics: does the method hold here? The four conditions of the paper's appendix D, and whether the score ranks.

The inverse dynamics verifies what it reads, the block z_S: few coordinates of many (mask), near to labeled ones
(support), from which one action follows (aliasing), whatever the rest of the world is like (back-action).
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from models.cycle_consistency import cycle
from models.evaluation import recovered
from models.inverse_dynamics.base import (
    ActionProbabilities,
    DiscreteInverseDynamics,
    InverseDynamics,
    VerifyingBlock,
)
from models.rank_correlation import kendall, spearman
from models.segments import SegmentBatch
from models.spaces import DiscreteAction
from models.step_distances import nearest_true_actions
from models.support import AfterEach, nearest, whole_observation
from models.world_models.base import WorldModel

CHUNK = 256  # segments a forward pass


@dataclass(frozen=True)
class Mask:
    """How many coordinates of an observation the inverse dynamics reads, mean over segments, and how many there are."""

    kept: float
    coordinates: int


@dataclass(frozen=True)
class Support:
    """Distance of pool segments' z_S to the nearest labeled one: of one-hot codes, how many differ.

    outside: share of segments that differ at all from every label. A segment is as far as its farthest step.
    """

    outside: float
    mean: float
    percentile_95: float


@dataclass(frozen=True)
class Aliasing:
    """Entropy in nats of the inferred actions of pool steps; above_ln_2: share with more doubt than between two."""

    mean: float
    percentile_95: float
    above_ln_2: float


@dataclass(frozen=True)
class BackAction:
    """Share of held-out steps whose action is inferred wrong, by how far their unmasked coordinates are from labels.

    nearest, farthest: of the steps up to the first and from the second third of the distances on. spearman: of
    distance and error, None where all distances or all errors are equal.
    """

    steps: int
    nearest: float
    farthest: float
    spearman: float | None


@dataclass(frozen=True)
class Ranking:
    """Rank correlation of score and true loss over held-out segments; None where nothing can be ranked."""

    segments: int
    spearman: float | None
    kendall: float | None


@dataclass(frozen=True)
class KnownAction:
    """What is known of an action, over the steps that it alone explains: any of several would tell little of each.

    labels: such steps in the training set. held_out: in the held-out set; accuracy: share of them inferred right.
    """

    labels: int
    held_out: int
    accuracy: float | None


@dataclass(frozen=True)
class Diagnostics:
    """Of one round. sampled: pool segments that were looked at; what needs labels or segments that lack is None.

    Of actions in a box there are the mask and the ranking: the others compare symbols, or count actions.

    back_action_in_support: over the steps whose z_S some label shows. There a rise is the rest's doing alone; over all
    steps the kinds of steps that the labels lack may lie near or far themselves.
    """

    sampled: int
    mask: Mask | None
    support: Support | None
    aliasing: Aliasing | None
    back_action: BackAction | None
    back_action_in_support: BackAction | None
    ranking: Ranking | None
    ranking_by_group: dict[str, Ranking]
    actions: tuple[KnownAction, ...]


@dataclass(frozen=True)
class _HeldOut:
    """Over held-out segments: score (B,), true loss (B,), inferred action is right, or how much of it (B, L)."""

    score: Tensor
    loss: Tensor
    right: Tensor


@torch.inference_mode()
def diagnose(
    world_model: WorldModel,
    inverse_dynamics: InverseDynamics,
    labeled: SegmentBatch,
    pool: SegmentBatch | None,
    held_out: SegmentBatch | None,
    groups: Mapping[str, set[int]],
    after_each: AfterEach = lambda: None,
) -> Diagnostics:
    """All figures, on the models' device. Nothing is drawn and nothing trained.

    labeled: what the round trained on. pool: a sample of the unlabeled segments. held_out: labeled held-out segments.
    groups: name -> actions; a segment belongs to those that any of its actions is in. Raises ValueError for labeled
    or held-out segments without actions, and for a score or loss that is not finite, naming its segment.
    """
    held = None if held_out is None else _held_out(world_model, inverse_dynamics, held_out, after_each)
    sampled, mask = 0 if pool is None else pool.size, None if pool is None else _mask(inverse_dynamics, pool)
    ranking = None if held is None else _ranking(held.score, held.loss)
    if not isinstance(inverse_dynamics, ActionProbabilities):
        return Diagnostics(sampled, mask, None, None, None, None, ranking, {}, ())
    members = {} if held_out is None else {name: _in_group(held_out, actions) for name, actions in groups.items()}
    back_action, in_support = _back_action(inverse_dynamics, labeled, held_out, held, after_each)
    return Diagnostics(
        sampled=sampled,
        mask=mask,
        support=None if pool is None else _support(inverse_dynamics, labeled, pool, after_each),
        aliasing=None if pool is None else _aliasing(inverse_dynamics, pool, after_each),
        back_action=back_action,
        back_action_in_support=in_support,
        ranking=ranking,
        ranking_by_group={}
        if held is None
        else {name: _ranking(held.score[chosen], held.loss[chosen]) for name, chosen in members.items()},
        actions=known_actions(
            explanations(inverse_dynamics, labeled),
            None if held_out is None else explanations(inverse_dynamics, held_out),
            None if held is None else held.right,
        ),
    )


def explanations(inverse_dynamics: DiscreteInverseDynamics, batch: SegmentBatch) -> Tensor:
    """The actions that explain each step, bool (B, L, n): the label's set, else its action alone.

    Raises ValueError for a batch without actions, and for an action space that is not discrete.
    """
    space = inverse_dynamics.spaces.action
    if not isinstance(space, DiscreteAction):
        raise ValueError(f"Diagnostics need a discrete action space, got {space}.")
    if batch.actions is None:
        raise ValueError("Diagnostics need labeled segments; the batch carries no actions.")
    return batch.explanations(space.n)


def known_actions(labels: Tensor, held_out: Tensor | None, right: Tensor | None) -> tuple[KnownAction, ...]:
    """What is known of each of n actions.

    labels, held_out: the actions that explain each step, bool (B, L, n). right: the inferred action of each held-out
    step is among them, bool (B, L).
    """
    alone = labels[labels.sum(-1) == 1].sum(0).tolist()  # (B, L, n) -> (n,)
    if held_out is None or right is None:
        return tuple(KnownAction(count, 0, None) for count in alone)
    unique = held_out.sum(-1) == 1  # (B, L)
    asked, inferred = held_out[unique].sum(0).tolist(), held_out[unique & right].sum(0).tolist()
    return tuple(
        KnownAction(count, of, good / of if of else None)
        for count, of, good in zip(alone, asked, inferred, strict=True)
    )


def _mask(inverse_dynamics: InverseDynamics, pool: SegmentBatch) -> Mask:
    kept = torch.cat([inverse_dynamics.kept(part.observations) for part in _chunks(pool)])
    return Mask(float(kept.double().mean()), inverse_dynamics.coordinates)


def _support(
    inverse_dynamics: DiscreteInverseDynamics, labeled: SegmentBatch, pool: SegmentBatch, after_each: AfterEach
) -> Support:
    # A model that does not say what it reads: all of the observation, which finds more segments new than are to it.
    describe = whole_observation(labeled.observations, pool.observations)
    if isinstance(inverse_dynamics, VerifyingBlock):
        describe, labeled = inverse_dynamics.verifying_block, inverse_dynamics.views(labeled)
    distance = nearest(describe, pool, labeled, after_each).view(pool.size, pool.length).amax(1).double()
    return Support(float((distance > 0).double().mean()), float(distance.mean()), float(distance.quantile(0.95)))


def _aliasing(inverse_dynamics: DiscreteInverseDynamics, pool: SegmentBatch, after_each: AfterEach) -> Aliasing:
    parts = []
    for part in _chunks(pool):
        parts.append(torch.special.entr(inverse_dynamics.log_prob(part).exp()).sum(-1).flatten())
        after_each()
    entropy = torch.cat(parts).double()
    above = float((entropy > math.log(2)).double().mean())
    return Aliasing(float(entropy.mean()), float(entropy.quantile(0.95)), above)


def _back_action(
    inverse_dynamics: DiscreteInverseDynamics,
    labeled: SegmentBatch,
    held_out: SegmentBatch | None,
    held: _HeldOut | None,
    after_each: AfterEach,
) -> tuple[BackAction | None, BackAction | None]:
    """Over all steps and over those in support; None also where nothing is left out, or the model does not say what."""
    if held_out is None or held is None or not isinstance(inverse_dynamics, VerifyingBlock):
        return None, None
    if not inverse_dynamics.rest(held_out.take(slice(0, 1)).observations).shape[1]:
        return None, None
    views = inverse_dynamics.views(labeled)
    rest = nearest(inverse_dynamics.rest, held_out, views, after_each).double()
    inside = nearest(inverse_dynamics.verifying_block, held_out, views, after_each) == 0
    wrong = 1.0 - held.right.flatten().double()
    return _error_by_distance(rest, wrong), _error_by_distance(rest[inside], wrong[inside])


def _error_by_distance(distance: Tensor, wrong: Tensor) -> BackAction | None:
    if not len(distance):
        return None
    low, high = distance.quantile(1 / 3), distance.quantile(2 / 3)  # ties stay together, so no order decides
    near, far = float(wrong[distance <= low].mean()), float(wrong[distance >= high].mean())
    return BackAction(len(distance), near, far, spearman(distance, wrong))


def _held_out(
    world_model: WorldModel, inverse_dynamics: InverseDynamics, held_out: SegmentBatch, after_each: AfterEach
) -> _HeldOut:
    parts = []
    for part in _chunks(held_out):
        inferred, score = cycle(world_model, inverse_dynamics, part.observations)
        right = recovered(inverse_dynamics, part, inferred)
        loss = nearest_true_actions(world_model, part)[1]
        _require_finite(part, score, loss)
        parts.append((score, loss, right))
        after_each()
    return _HeldOut(*(torch.cat(each) for each in zip(*parts, strict=True)))


def _require_finite(batch: SegmentBatch, score: Tensor, loss: Tensor) -> None:
    bad = (~torch.isfinite(score + loss)).nonzero().flatten().tolist()
    if bad:
        named = batch.segments[bad[0]] if batch.segments else f"row {bad[0]}"
        raise ValueError(f"Held-out {named} has score {float(score[bad[0]])} and true loss {float(loss[bad[0]])}.")


def _ranking(score: Tensor, loss: Tensor) -> Ranking:
    return Ranking(len(score), spearman(score, loss), kendall(score, loss))


def _in_group(batch: SegmentBatch, actions: set[int]) -> Tensor:
    """Segments (B,) of which any action is in the group."""
    if batch.actions is None:
        raise ValueError("Diagnostics need labeled segments; the batch carries no actions.")
    return torch.isin(batch.actions, torch.tensor(sorted(actions), device=batch.actions.device)).any(1)


def _chunks(batch: SegmentBatch) -> Iterator[SegmentBatch]:
    return (batch.take(slice(start, start + CHUNK)) for start in range(0, batch.size, CHUNK))
