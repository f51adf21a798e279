"""How much of figure 5 is run: enough for a look, for two processor cores, or all that the paper has."""

from dataclasses import dataclass, replace

import torch

from benchmarks.paper.robots.arms import FEW, MANY
from benchmarks.paper.robots.datasets import EXPERT, LENGTH, PolicySpec, Recording
from models.families import Family, family_named
from models.network import Network
from models.spaces import Spaces
from models.training import TrainingConfig
from models.world_models.recurrent import Distance


@dataclass(frozen=True)
class TaskPlan:
    """Trajectories of the expert, of the best stage, of each stage in the pool, and of the stage that validates."""

    simulator: str
    name: str
    expert: int
    best: int
    each: int
    validating: int


@dataclass(frozen=True)
class Profile:
    """What all arms of a comparison share.

    warm: labeled trajectories that the first round learns from, half of the expert, half of the best stage; a
    comparison each. batch: segments that are labeled in each of `batches` rounds. validates: the stage that tests and
    is neither in the warm-up nor in the pool. shorter: by what schedules are divided, for a look. distance: of world
    models, where it is not the preset's.
    """

    name: str
    tasks: tuple[TaskPlan, ...]
    preset: str
    arms: tuple[str, ...]
    warm: tuple[int, ...]
    batch: int
    batches: int = 2
    seeds: int = 3
    cameras: bool = True
    demonstrations: int = 300
    policy_steps: int | None = None
    stages: int = 10
    validates: int = 5
    horizons: tuple[int, ...] = (8, 32)
    shorter: int = 1
    distance: Distance | None = None

    @property
    def family(self) -> Family:
        """Builds the networks and says their schedules."""
        return family_named("robot", self.preset)

    def build(self, kind: str, spaces: Spaces, generator: torch.Generator) -> Network:
        """A network of the preset."""
        told = {} if self.distance is None or kind != "world_model" else {"distance": self.distance}
        return self.family.build(kind, spaces, told, generator)

    def schedule(self, kind: str, segments: int, first: bool) -> TrainingConfig | None:
        """Of a network's first training, or of one from the weights of the round before, where there is such."""
        family = self.family
        config = family.training_config(kind, segments) if first else family.further_config(kind, segments)
        return None if config is None else replace(config, steps=max(1, config.steps // self.shorter))

    def policy(self, task: TaskPlan) -> PolicySpec:
        """Whose stages act."""
        return PolicySpec(task.simulator, task.name, self.demonstrations, self.policy_steps, self.stages)

    def expert(self, task: TaskPlan) -> Recording:
        """Half of what is labeled at first is drawn from it."""
        return self._recording(task, EXPERT, task.expert)

    def best(self, task: TaskPlan) -> Recording:
        """The other half."""
        return self._recording(task, self.stages, task.best)

    def pool(self, task: TaskPlan) -> tuple[Recording, ...]:
        """The imperfect stages."""
        stages = (stage for stage in range(1, self.stages) if stage != self.validates)
        return tuple(self._recording(task, stage, task.each) for stage in stages)

    def validating(self, task: TaskPlan) -> Recording:
        """On what every model is tested."""
        return self._recording(task, self.validates, task.validating)

    def recordings(self, task: TaskPlan) -> tuple[Recording, ...]:
        """All of them."""
        return (self.expert(task), self.best(task), self.validating(task), *self.pool(task))

    def _recording(self, task: TaskPlan, stage: int, trajectories: int) -> Recording:
        return Recording(self.policy(task), stage, trajectories, self.cameras, LENGTH)


QUICK = Profile(
    "quick",
    (TaskPlan("maniskill", "PullCube", 4, 4, 8, 4),),
    "small",
    ("random", "cycle", "oracle", "all"),
    warm=(6,),
    batch=4,
    seeds=1,
    cameras=False,
    demonstrations=4,
    policy_steps=20,
    stages=3,
    validates=2,
    shorter=60,
)
SMALL = Profile(
    "small",
    (TaskPlan("robosuite", "Lift", 30, 30, 25, 40), TaskPlan("maniskill", "PullCube", 60, 60, 50, 60)),
    "small",
    FEW,
    warm=(60,),
    batch=40,
)
PAPER = Profile(
    "paper",
    (
        TaskPlan("robosuite", "Lift", 500, 500, 55, 60),
        TaskPlan("robosuite", "PickPlaceCan", 500, 500, 55, 60),
        TaskPlan("robosuite", "NutAssemblySquare", 500, 500, 55, 60),
        TaskPlan("maniskill", "PullCube", 500, 500, 55, 60),
        TaskPlan("maniskill", "PokeCube", 500, 500, 55, 60),
        TaskPlan("maniskill", "LiftPegUpright", 500, 500, 55, 60),
    ),
    "paper",
    MANY,
    warm=(200, 400, 600, 800, 1000),
    batch=120,
)
PROFILES = {profile.name: profile for profile in (QUICK, SMALL, PAPER)}
