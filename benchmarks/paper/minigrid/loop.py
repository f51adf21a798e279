"""The active-learning loop offline: what a project of the service does, straight on models/, draw for draw.

Training, scoring, batch rules, labels and the names of all draws are the service's own, so one seed gives the picks of
a project of that seed. No database, no HTTP and no files but the networks of the first round, which all arms share.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.paper.minigrid.arms import Arm
from benchmarks.paper.minigrid.datasets import GROUPS, draw_labels
from benchmarks.paper.runs import write_at_once
from models import checkpoints
from models.acquisition import STRATEGIES, Models, Strategy, describe, score_pool, top
from models.chance import scoring_generator, training_generator
from models.evaluation import ModelError, evaluate
from models.families import GRID
from models.network import Network
from models.segments import SegmentBatch, concatenate
from models.spaces import Spaces
from models.step_distances import nearest_true_actions
from models.training import train
from workers.data import CHUNK_SEGMENTS
from workers.training import BASE, ENSEMBLE_MEMBERS

Networks = dict[tuple[str, int], Network]  # by kind and member


@dataclass(frozen=True)
class Plan:
    """How many labels at first, how many a batch, how many batches; the length of the ranked queue."""

    seed_labels: int = 200
    batch_labels: int = 100
    batches: int = 3
    queue_length: int = 2000


@dataclass(frozen=True)
class Round:
    """What a round is after its training: labels so far, networks, and what is then picked and labeled.

    picks: rows of the pool, those that were explored from in explore mode. chosen: what came of them, labeled; None
    after the last round.
    """

    number: int
    labeled: SegmentBatch
    models: Models
    picks: Tensor
    scores: Tensor  # (N,) of the whole pool; none in explore mode
    chosen: SegmentBatch | None


@dataclass(frozen=True)
class Experiment:
    """One arm from one seed. pool: unlabeled segments with their hidden action sets, in the order of membership.

    seed_set: the first labels, where they are not drawn from the pool. video: what the subgoal generator sees, where
    that is not the pool.
    """

    arm: Arm
    seed: int
    spaces: Spaces
    pool: SegmentBatch
    shared: Path | None = None  # folder for the first round's networks
    plan: Plan = Plan()
    seed_set: SegmentBatch | None = None
    video: SegmentBatch | None = None

    def rounds(self) -> Iterator[Round]:
        """`batches` + 1 rounds; the last one picks nothing."""
        rng = np.random.default_rng(self.seed)  # of the labeling worker
        free = torch.ones(self.pool.size, dtype=torch.bool)
        labeled, previous = list[SegmentBatch](), None
        picks = self._first_picks()
        chosen = self.seed_set or draw_labels(self.pool.take(picks), rng)
        for number in range(1, self.plan.batches + 2):
            labeled.append(chosen)
            free[picks] = False
            everything = concatenate(labeled)
            models = replace(self._trained(number, everything), previous_world_model=previous)
            scores = self._scores(number, models)
            if number > self.plan.batches:
                yield Round(number, everything, models, torch.zeros(0, dtype=torch.int64), scores, None)
                return
            picks, chosen = self._chosen(number, models, scores, free, rng)
            yield Round(number, everything, models, picks, scores, chosen)
            previous = models.world_model

    @property
    def trajectories(self) -> int:
        """How many the pool's segments come from."""
        return len({segment.trajectory for segment in self.pool.segments})

    def _first_picks(self) -> Tensor:
        """Before any model there is only chance, the same for all arms of a seed."""
        return top(self._uniform(), 0 if self.seed_set is not None else self.plan.seed_labels)

    def _uniform(self) -> Tensor:
        generator = scoring_generator(self.seed, "random", 0, self.trajectories, "shard 0")
        return torch.rand(self.pool.size, generator=generator)

    def _trained(self, number: int, labeled: SegmentBatch) -> Models:
        kinds = (BASE | self.arm.scores.needs) - {"previous_world_model"}
        networks: Networks = {}
        for kind in sorted(kinds):
            for member in range(ENSEMBLE_MEMBERS if kind == "ensemble" else 1):
                networks[kind, member] = self._network(number, kind, member, labeled)
        single = {kind: network for (kind, _), network in networks.items() if kind != "ensemble"}
        ensemble = tuple(network for (kind, _), network in networks.items() if kind == "ensemble")
        return Models(**single, ensemble=ensemble)  # type: ignore[arg-type]  # kinds are the fields of Models

    def _network(self, number: int, kind: str, member: int, labeled: SegmentBatch) -> Network:
        """The subgoal generator and the first round's networks do not depend on the arm: they are kept and shared."""
        if kind == "subgoal_generator":
            number, labeled = 0, (self.video or self.pool).without_labels()
        kept = self.shared / f"seed-{self.seed}-{kind}-{member}.safetensors" if self.shared and number < 2 else None
        if kept is not None and kept.exists():
            return checkpoints.load(kept.read_bytes())
        built = "world_model" if kind == "ensemble" else kind
        generator = training_generator(self.seed, number, kind, member)
        network = GRID.build(built, self.spaces, {}, generator)
        train(network, labeled, GRID.training_config(built, labeled.size), generator)
        if kept is not None:
            write_at_once(kept, checkpoints.save(network))
        return network

    def _scores(self, number: int, models: Models) -> Tensor:
        """(N,), in the parts in which a scoring job reads the pool: sums of floats depend on how they are cut."""
        if not self.arm.scores.needs:
            return self._uniform()
        generator = scoring_generator(self.seed, self.arm.strategy, number, self.trajectories, "shard 0")
        strategy, seen = self.arm.scores, _seen(self.arm.scores, self.pool)
        if strategy.privileged:  # never scored by the service; some need the whole pool at once, or double precision
            return score_pool(strategy, models, seen, generator)
        return torch.cat([score_pool(strategy, models, part, generator) for part in parts_of(seen)]).float()

    def _chosen(
        self, number: int, models: Models, scores: Tensor, free: Tensor, rng: np.random.Generator
    ) -> tuple[Tensor, SegmentBatch]:
        """The next rows of the pool, and their labels."""
        picks = self._picks(number, models, scores, free)
        return picks, draw_labels(self.pool.take(picks), rng)

    def _picks(self, number: int, models: Models, scores: Tensor, free: Tensor) -> Tensor:
        ranked = top(scores, len(scores))
        candidates = ranked[free[ranked]][: self.plan.queue_length]
        strategy, rule = self.arm.scores, self.arm.orders
        if not strategy.needs:
            return candidates[: self.plan.batch_labels]
        generator = scoring_generator(self.seed, self.arm.strategy, number, self.trajectories, "selection 0")
        described = describe(rule, strategy, models, _seen(strategy, self.pool).take(candidates), scores[candidates])
        return candidates[rule.order(described, len(candidates), generator)][: self.plan.batch_labels]


def parts_of(pool: SegmentBatch) -> Iterator[SegmentBatch]:
    """Whole trajectories, about CHUNK_SEGMENTS segments a part, as workers read them."""
    start, names = 0, pool.segments
    for place in range(1, pool.size + 1):
        ends = place == pool.size or names[place].trajectory != names[place - 1].trajectory
        if ends and (place - start >= CHUNK_SEGMENTS or place == pool.size):
            yield pool.take(slice(start, place))
            start = place


def errors(
    models: Models, tests: Mapping[str, SegmentBatch], groups: Mapping[str, set[int]] = GROUPS
) -> dict[str, ModelError]:
    """Model error on each labeled test set, overall and by group."""
    assert models.world_model is not None
    return {name: evaluate(models.world_model, test, groups, models.inverse_dynamics) for name, test in tests.items()}


def pool_losses(models: Models, pool: SegmentBatch) -> Tensor:
    """The true loss (N,) of each segment, the smallest over the actions that explain it."""
    assert models.world_model is not None
    with torch.inference_mode():
        return torch.cat([nearest_true_actions(models.world_model, part)[1] for part in parts_of(pool)])


def strategy_scores(strategy: str, models: Models, batch: SegmentBatch) -> Tensor:
    """Scores (B,) of a strategy that draws nothing."""
    chosen = STRATEGIES[strategy]
    return score_pool(chosen, models, _seen(chosen, batch), torch.Generator())


def _seen(strategy: Strategy, batch: SegmentBatch) -> SegmentBatch:
    """What a strategy may look at: the labels only if it is privileged."""
    return batch if strategy.privileged else batch.without_labels()
