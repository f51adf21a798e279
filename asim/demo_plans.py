"""How much the demo does, in which environment: one plan for MiniGrid, one for the robots."""

from dataclasses import dataclass
from typing import Protocol
from uuid import UUID

from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.environments import ROBOTS, Environment
from api_schemas.projects import LabelingPolicy, ProjectCreate
from api_schemas.strategies import StrategyName
from asim.errors import AsimError
from workers.simulators.base import SimulatorUnavailable
from workers.simulators.catalog import SIMULATORS, make_simulator

HELD_OUT_SEED = 1_000_000  # added to the demo's seed, so that no test layout is drawn like a pool layout
SEED_SET_SEED = 2_000_000  # likewise, of labels that the first round begins with


class Plan(Protocol):
    """What an arm is made of: its project, what is collected for it, and how many labels it gets.

    seed_labels: drawn at random for the first round; 0 where collections bring its labels with them.
    """

    @property
    def seed_labels(self) -> int: ...

    @property
    def batch_labels(self) -> int: ...

    @property
    def batches(self) -> int: ...

    @property
    def name(self) -> str:
        """What the files of its results begin with."""

    def check(self) -> None:
        """Raises AsimError where this machine cannot run it, with the command that helps."""

    def project(self, name: str, strategy: StrategyName, seed: int) -> ProjectCreate:
        """An arm's project."""

    def collections(self, project: UUID, seed: int) -> dict[str, CollectionCreate]:
        """What is collected, by what it is called, one after the other."""


@dataclass(frozen=True)
class DemoPlan:
    """MiniGrid; a test runs a small one."""

    pool_transitions: int = 28_000
    test_transitions: int = 60_000
    test_labels_per_action: int = 200
    seed_labels: int = 200
    batch_labels: int = 100
    batches: int = 3
    name: str = "demo"

    def check(self) -> None:
        """It comes with the product."""

    def project(self, name: str, strategy: StrategyName, seed: int) -> ProjectCreate:
        """Rooms of size 6 with three objects, of any task."""
        options: dict[str, str | int | float | bool] = {"task": "any", "room_size": 6, "objects": 3}
        environment = Environment(simulator="minigrid", options=options)
        policy = LabelingPolicy(strategy=strategy, round_labels=self.seed_labels)
        return ProjectCreate(name=name, environment=environment, seed=seed, policy=policy)

    def collections(self, project: UUID, seed: int) -> dict[str, CollectionCreate]:
        """The pool by a noisy mixture of solvers and random play, the test set balanced by action."""
        pool = CollectionCreate(
            project=project, behavior="mixture", transitions=self.pool_transitions, seed=seed, split="pool"
        )
        test_set = CollectionCreate(
            project=project,
            behavior="balanced",
            transitions=self.test_transitions,
            seed=HELD_OUT_SEED + seed,
            split="held_out",
            labels=CollectionLabels(per_action=self.test_labels_per_action),
        )
        return {
            f"{self.pool_transitions} transitions for the pool": pool,
            f"a test set, {self.test_labels_per_action} labels an action": test_set,
        }


@dataclass(frozen=True)
class RobotPlan:
    """A task of a robot simulator, seen through two cameras.

    task: default the simulator's first. All transitions are those of the noisy expert, in good and bad episodes; those
    of the seed set and of the test set are labeled as they are collected.
    """

    simulator: str
    task: str | None = None
    cameras: bool = True
    segment_length: int = 16
    seed_transitions: int = 2500
    pool_transitions: int = 6500
    test_transitions: int = 1600
    batch_labels: int = 80
    batches: int = 2
    seed_labels: int = 0

    @property
    def name(self) -> str:
        """With the task, where one was asked for."""
        return "-".join(["demo", self.simulator, *([self.task] if self.task else [])])

    def check(self) -> None:
        """Raises AsimError with the command that installs the simulator."""
        try:
            make_simulator(self.simulator, self._environment().options).close()
        except SimulatorUnavailable as error:
            raise AsimError(str(error)) from error

    def project(self, name: str, strategy: StrategyName, seed: int) -> ProjectCreate:
        """Segments are of several steps: one step of a robot tells little."""
        policy = LabelingPolicy(strategy=strategy, round_labels=0)
        environment, length = self._environment(), self.segment_length
        return ProjectCreate(name=name, environment=environment, segment_length=length, seed=seed, policy=policy)

    def collections(self, project: UUID, seed: int) -> dict[str, CollectionCreate]:
        """By the simulator's default behavior, three sets that share no episode."""
        labels = CollectionLabels(all=True)
        seeds = CollectionCreate(
            project=project, transitions=self.seed_transitions, seed=SEED_SET_SEED + seed, split="pool", labels=labels
        )
        pool = CollectionCreate(project=project, transitions=self.pool_transitions, seed=seed, split="pool")
        test_set = CollectionCreate(
            project=project,
            transitions=self.test_transitions,
            seed=HELD_OUT_SEED + seed,
            split="held_out",
            labels=labels,
        )
        return {
            f"{self.seed_transitions} labeled transitions": seeds,
            f"{self.pool_transitions} transitions for the pool": pool,
            f"{self.test_transitions} labeled transitions for a test set": test_set,
        }

    def _environment(self) -> Environment:
        task: dict[str, str | int | float | bool] = {} if self.task is None else {"task": self.task}
        return Environment(simulator=self.simulator, options={"cameras": self.cameras, **task})


def plan_of(simulator: str, task: str | None) -> Plan:
    """The plan of `asim demo`. Raises AsimError for a simulator that there is not, or a task of MiniGrid."""
    if simulator not in SIMULATORS:
        raise AsimError(f"--simulator {simulator}: must be one of {', '.join(sorted(SIMULATORS))}")
    if simulator in ROBOTS:
        return RobotPlan(simulator, task)
    if task is not None:
        raise AsimError(f"--task {task}: the demo on {simulator} is of all its tasks")
    return DemoPlan()
