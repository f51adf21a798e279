"""The active-learning loop on robots, offline: warm-up on good behavior, then rounds that choose from the rest.

What is labeled are segments, as in a project of the service: whole trajectories end early where they succeed, so equal
numbers of them would be unequal numbers of labels. Every minibatch is drawn from all that is labeled alike; no part of
it is kept for the expert, so that what was chosen is what is learned from.
"""

from collections.abc import Iterator, Set
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from shutil import rmtree

import torch
from torch import Tensor

from benchmarks.paper.robots import datasets, networks
from benchmarks.paper.robots.arms import RobotArm
from benchmarks.paper.robots.profiles import Profile, TaskPlan
from models.acquisition import Models, Strategy, describe, score_pool, top
from models.chance import scoring_generator, training_generator
from models.network import Network
from models.segments import SegmentBatch, concatenate
from models.spaces import Spaces
from workers.training import ENSEMBLE_MEMBERS

Member = tuple[str, int]  # a kind of network and its place in an ensemble


@dataclass(frozen=True)
class Data:
    """Segments of the expert, of the best stage and of the imperfect ones; windows of the validating stage."""

    expert: SegmentBatch
    best: SegmentBatch
    pool: SegmentBatch
    tests: SegmentBatch

    @property
    def spaces(self) -> Spaces:
        """Of the robot."""
        return datasets.spaces_of(self.pool)

    def warm_up(self, trajectories: int, seed: int) -> SegmentBatch:
        """All segments of so many trajectories, half of the expert, half of the best stage, drawn by the seed.

        Raises ValueError where fewer are recorded.
        """
        generator = torch.Generator().manual_seed(seed)
        half = trajectories // 2
        return concatenate([_drawn(self.expert, trajectories - half, generator), _drawn(self.best, half, generator)])


@cache
def load(profile: Profile, task: TaskPlan, folder: Path) -> Data:
    """Once a process."""
    horizon = max(profile.horizons)
    return Data(
        datasets.load([profile.expert(task)], folder),
        datasets.load([profile.best(task)], folder),
        datasets.load(profile.pool(task), folder),
        datasets.windows([profile.validating(task)], folder, horizon),
    )


@dataclass(frozen=True)
class Round:
    """What a round is after its training; scores (N,) of the whole pool, and which rows of it are labeled next.

    The last one trains a world model only, which is tested: it scores and picks nothing.
    """

    number: int
    labeled: SegmentBatch
    models: Models
    scores: Tensor | None
    picks: Tensor


@dataclass(frozen=True)
class Experiment:
    """One arm from one seed and one number of labeled trajectories.

    shared: folder of the first round's networks, which do not depend on the arm. own: of the later rounds', for who
    goes on after a stop.
    """

    profile: Profile
    data: Data
    arm: RobotArm
    seed: int
    warm: int
    shared: Path
    own: Path
    device: str = "cpu"

    def rounds(self) -> Iterator[Round]:
        """`batches` + 1 of them."""
        pool = self.data.pool.to(self.device)
        free = torch.ones(pool.size, dtype=torch.bool)
        labeled, found = self.data.warm_up(self.warm, self.seed), dict[Member, Network]()
        previous = None
        for number in range(1, self.profile.batches + 1):
            found = self._trained(number, labeled, found, self._kinds)
            models = replace(_models(found), previous_world_model=previous)
            scores = self._scores(number, models, pool)
            picks = self._picks(number, models, scores, free, pool)
            yield Round(number, labeled, models, scores, picks)
            free[picks] = False
            labeled = concatenate([labeled, self.data.pool.take(picks)]) if len(picks) else labeled
            previous = models.world_model
        last = self._trained(self.profile.batches + 1, labeled, found, {"world_model"})
        yield Round(self.profile.batches + 1, labeled, _models(last), None, torch.zeros(0, dtype=torch.int64))

    def finish(self) -> None:
        """Deletes the later rounds' networks."""
        rmtree(self.own, ignore_errors=True)

    @property
    def _strategy(self) -> Strategy:
        return self.arm.arm.scores

    def warmed_up(self) -> Models:
        """What the arm needs, after the warm-up."""
        return _models(self._trained(1, self.data.warm_up(self.warm, self.seed), {}, self._kinds))

    @property
    def _kinds(self) -> frozenset[str]:
        return (self._strategy.needs | {"world_model"}) - {"previous_world_model"}

    def _trained(
        self, number: int, labeled: SegmentBatch, before: dict[Member, Network], kinds: Set[str]
    ) -> dict[Member, Network]:
        members = [(k, m) for k in sorted(kinds) for m in range(ENSEMBLE_MEMBERS if k == "ensemble" else 1)]
        return {member: self._network(number, member, labeled, before.get(member)) for member in members}

    def _network(self, number: int, member: Member, labeled: SegmentBatch, before: Network | None) -> Network:
        """From the weights of the round before where there are such and its schedule says so.

        What the subgoal generator learns from no label adds to: it is trained once, for all arms.
        """
        kind, place = member
        number, before = (1, None) if kind == "subgoal_generator" else (number, before)
        built = "world_model" if kind == "ensemble" else kind
        folder = self.shared if number == 1 else self.own
        path = folder / f"{kind}-{place}-{number}.safetensors"
        if path.exists():
            return networks.load(path, self.device)
        video = self.data.pool.without_labels()
        seen = video if kind == "subgoal_generator" else labeled
        generator = training_generator(self.seed, number, kind, place)
        further = self.profile.schedule(built, seen.size, first=False) if before is not None else None
        if further is None or before is None:
            network = self.profile.build(built, self.data.spaces, generator)
            config = self.profile.schedule(built, seen.size, first=True)
            assert config is not None
        else:
            network, config = deepcopy(before), further  # progress compares with the round before
        return networks.trained(network, seen, video, config, generator, self.device, path)

    def _scores(self, number: int, models: Models, pool: SegmentBatch) -> Tensor:
        generator = self._chance(number, "shard 0")
        return score_pool(self._strategy, models, self._seen(pool), generator)

    def _picks(self, number: int, models: Models, scores: Tensor, free: Tensor, pool: SegmentBatch) -> Tensor:
        ranked = top(scores, len(scores))
        candidates = ranked[free[ranked]]
        if self.arm.whole_pool:
            return candidates
        seen = self._seen(pool).take(candidates.to(self.device))
        described = describe(self.arm.arm.orders, self._strategy, models, seen, scores[candidates])
        order = self.arm.arm.orders.order(described, self.profile.batch, self._chance(number, "selection 0"))
        return candidates[order]

    def _chance(self, number: int, what: str) -> torch.Generator:
        return scoring_generator(self.seed, self.arm.arm.strategy, number, self.warm, what)

    def _seen(self, pool: SegmentBatch) -> SegmentBatch:
        """The labels only where the strategy is privileged."""
        return pool if self._strategy.privileged else pool.without_labels()


def _models(found: dict[Member, Network]) -> Models:
    single = {kind: network for (kind, _), network in found.items() if kind != "ensemble"}
    ensemble = tuple(network for (kind, _), network in found.items() if kind == "ensemble")
    return Models(**single, ensemble=ensemble)  # type: ignore[arg-type]  # kinds are the fields of Models


def _drawn(batch: SegmentBatch, trajectories: int, generator: torch.Generator) -> SegmentBatch:
    """All segments of some of the batch's trajectories."""
    names = list(dict.fromkeys(segment.trajectory for segment in batch.segments))
    if len(names) < trajectories:
        raise ValueError(f"{trajectories} trajectories are to be labeled at first, but {len(names)} are recorded.")
    chosen = {names[place] for place in torch.randperm(len(names), generator=generator)[:trajectories].tolist()}
    rows = [row for row, segment in enumerate(batch.segments) if segment.trajectory in chosen]
    return batch.take(torch.tensor(rows, dtype=torch.int64))
