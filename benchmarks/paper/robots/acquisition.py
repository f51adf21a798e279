"""One arm on one task from one seed: warm-up, two rounds, and what is told of each."""

import io
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.paper.robots import loop
from benchmarks.paper.robots.arms import RobotArm
from benchmarks.paper.robots.errors import (
    inverse_error,
    open_loop,
    predicted,
    ranks,
    standing_still,
    true_losses,
)
from benchmarks.paper.robots.loop import Data, Experiment, Round
from benchmarks.paper.robots.profiles import Profile, TaskPlan
from benchmarks.paper.runs import ROBOT_CODE, Json, write_at_once
from models.chance import training_generator
from models.segments import SegmentBatch

RANKED = 400  # segments of the pool on which scores are held against true losses, the same for all arms of a seed
SHOWN = (*range(1, 9), 16, 24, 32)  # frames in pictures
EXAMPLES = 3


@dataclass(frozen=True)
class ArmRun:
    """Where recordings and networks lie is no part of its name. device: of training and scoring."""

    profile: Profile
    task: TaskPlan
    arm: RobotArm
    warm: int
    seed: int
    data: Path
    networks: Path
    pictures: Path
    device: str = "cpu"

    @property
    def name(self) -> str:
        """Of its file."""
        arm = self.arm.name.replace(":", "-")
        return "-".join((self.profile.name, self.task.name, str(self.warm), arm, str(self.seed)))

    @property
    def rollouts(self) -> Path:
        """Where the last model's predictions are kept."""
        return self.pictures / f"{self.name}.npz"

    def results(self) -> Json:
        """Of every round: errors, ranks, what was picked, and processor time."""
        data = loop.load(self.profile, self.task, self.data)
        experiment, rounds = self._experiment(data), list[Json]()
        began = time.process_time()
        for found in experiment.rounds():
            trained = time.process_time()
            rounds.append(self._told(found, data) | {"training_and_scoring": trained - began})
            began = time.process_time()
            if found.scores is None:
                self._keep_rollouts(found, data)
        experiment.finish()
        about = {"task": self.task.name, "arm": self.arm.name, "warm": self.warm, "seed": self.seed}
        still = standing_still(data.tests, self.profile.horizons, data.spaces)
        return {**about, "also": ROBOT_CODE, "pool": data.pool.size, "still": still, "rounds": rounds}

    def _experiment(self, data: Data) -> Experiment:
        shared = self.networks / f"{self.profile.name}-{self.task.name}-{self.warm}-{self.seed}"
        own = self.networks / self.name
        return Experiment(self.profile, data, self.arm, self.seed, self.warm, shared, own, self.device)

    def _told(self, found: Round, data: Data) -> Json:
        world_model = found.models.world_model
        assert world_model is not None
        tests = data.tests.to(self.device)
        return {
            "labels": found.labeled.size,
            "transitions": found.labeled.size * found.labeled.length,
            "errors": open_loop(world_model, tests, self.profile.horizons),
            "ranks": self._ranks(found, data),
            "inverse": inverse_error(found.models, tests),
            "picks": self._picks(found, data),
        }

    def _ranks(self, found: Round, data: Data) -> Json:
        """None of an arm that looks at nothing, or where nothing is chosen."""
        world_model = found.models.world_model
        if found.scores is None or not self.arm.arm.scores.needs or world_model is None:
            return {}
        rows = ranked_rows(data.pool, self.seed)
        return ranks(found.scores[rows], true_losses(world_model, data.pool.take(rows).to(self.device)))

    def _picks(self, found: Round, data: Data) -> Json:
        """Which segments, and how many of each source. Of the whole pool only how many."""
        chosen = [data.pool.segments[row] for row in found.picks.tolist()]
        sources = [segment.trajectory.partition("/")[0] for segment in chosen]
        return {
            "segments": [] if self.arm.whole_pool else [[segment.trajectory, segment.start] for segment in chosen],
            "sources": {source: sources.count(source) for source in sorted(set(sources))},
        }

    def _keep_rollouts(self, found: Round, data: Data) -> None:
        """Pictures are drawn when all arms have run."""
        assert found.models.world_model is not None
        shown, steps = examples(data.tests), [step for step in SHOWN if step <= data.tests.length]
        guess = predicted(found.models.world_model, shown.to(self.device), steps)
        packed = io.BytesIO()
        np.savez_compressed(packed, **{name: stream.numpy() for name, stream in guess.items()})
        write_at_once(self.rollouts, packed.getvalue())


def ranked_rows(pool: SegmentBatch, seed: int) -> Tensor:
    """int64, at most RANKED."""
    return torch.randperm(pool.size, generator=training_generator(seed, 0, "ranked"))[:RANKED]


def examples(tests: SegmentBatch) -> SegmentBatch:
    """Evenly spaced over the tests."""
    count = min(EXAMPLES, tests.size)
    return tests.take(torch.arange(count) * (tests.size // count))
