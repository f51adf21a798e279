"""Which world model, inverse dynamics and subgoal generator belong together, and how each is trained by default."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import torch

from models.inverse_dynamics import latent_action, latent_gates
from models.inverse_dynamics.base import DiscreteInverseDynamics, InverseDynamics
from models.inverse_dynamics.gates import (
    GridCellMaskedInverseDynamics,
    GridLatentMaskedInverseDynamics,
    MaskedInverseDynamicsConfig,
)
from models.inverse_dynamics.grid import (
    DenseInverseDynamicsConfig,
    GridDenseInverseDynamics,
    GridSparseInverseDynamics,
    SparseInverseDynamicsConfig,
)
from models.inverse_dynamics.latent_action import LatentActionConfig, LatentActionInverseDynamics
from models.inverse_dynamics.latent_gates import LatentGatesConfig, LatentMaskedInverseDynamics
from models.network import KINDS, Network
from models.networks.observation import check_spaces as check_robot_spaces
from models.spaces import BoxAction, DiscreteAction, Spaces, StreamSpec
from models.subgoal_generators import latent
from models.subgoal_generators.base import SubgoalGenerator
from models.subgoal_generators.grid import GridSubgoalGenerator, GridSubgoalGeneratorConfig
from models.subgoal_generators.latent import LatentSubgoalGenerator, LatentSubgoalGeneratorConfig
from models.training import TrainingConfig
from models.world_models import recurrent
from models.world_models.base import WorldModel
from models.world_models.grid import GridWorldModel, GridWorldModelConfig
from models.world_models.recurrent import RecurrentWorldModel, RecurrentWorldModelConfig

__all__ = [
    "FAMILIES",
    "GRID",
    "PRESETS",
    "ROBOT",
    "ROBOT_PAPER",
    "BoxAction",
    "DiscreteAction",
    "Family",
    "GridFamily",
    "RobotFamily",
    "Spaces",
    "StreamSpec",
    "family_named",
]

InverseKind = Literal["sparse", "dense", "masked"]


class Family(Protocol):
    """Builds the networks of one kind of environment. A config of None is the family's default."""

    @property
    def name(self) -> str: ...

    def check_spaces(self, spaces: Spaces) -> None:
        """Raises ValueError, in a sentence, for spaces the family cannot take."""
        ...

    def build_world_model(self, spaces: Spaces, config: Any, generator: torch.Generator) -> WorldModel: ...

    def build_inverse_dynamics(
        self, spaces: Spaces, kind: InverseKind, config: Any, generator: torch.Generator
    ) -> InverseDynamics: ...

    def build_subgoal_generator(self, spaces: Spaces, config: Any, generator: torch.Generator) -> SubgoalGenerator: ...

    def build(self, kind: str, spaces: Spaces, config: Mapping[str, Any], generator: torch.Generator) -> Network:
        """The network of `kind` (one of KINDS) from its config as JSON. Raises ValueError for another kind."""
        ...

    def training_config(self, kind: str, segments: int) -> TrainingConfig:
        """The default schedule for `kind` on that many segments. Raises ValueError for an unknown kind."""
        ...

    def further_config(self, kind: str, segments: int) -> TrainingConfig | None:
        """The schedule from the weights of the round before; None: every round trains `kind` from scratch.

        Raises ValueError for an unknown kind.
        """
        ...


@dataclass(frozen=True)
class GridFamily:
    """Grid worlds in MiniGrid's observation code: streams `grid` (S, S, 3) and `carried` (3,), discrete actions."""

    name: str = "grid"

    def check_spaces(self, spaces: Spaces) -> None:
        """Raises ValueError, in a sentence, for spaces other than the family's."""
        streams = spaces.observations
        if set(streams) != {"grid", "carried"}:
            raise ValueError(f"The grid family takes the streams 'grid' and 'carried', got {sorted(streams)}.")
        shape = streams["grid"].shape
        if len(shape) != 3 or shape[0] != shape[1] or shape[0] < 3 or shape[2] != 3:
            raise ValueError(f"grid must have shape (S, S, 3) with S of at least 3, got {shape}.")
        if streams["carried"].shape != (3,):
            raise ValueError(f"carried must have shape (3,), got {streams['carried'].shape}.")
        for name, stream in streams.items():
            if stream.dtype != "uint8":
                raise ValueError(f"{name} must be uint8, got {stream.dtype}.")
        if not isinstance(spaces.action, DiscreteAction) or spaces.action.n < 2:
            raise ValueError(f"The grid family takes a discrete action space of at least 2, got {spaces.action}.")

    def build_world_model(
        self, spaces: Spaces, config: GridWorldModelConfig | None, generator: torch.Generator
    ) -> GridWorldModel:
        """All parameters are drawn from `generator`."""
        self.check_spaces(spaces)
        return GridWorldModel(spaces, config or GridWorldModelConfig(), generator)

    def build_inverse_dynamics(
        self,
        spaces: Spaces,
        kind: InverseKind,
        config: SparseInverseDynamicsConfig | DenseInverseDynamicsConfig | MaskedInverseDynamicsConfig | None,
        generator: torch.Generator,
    ) -> DiscreteInverseDynamics:
        """All parameters are drawn from `generator`. Raises ValueError for a kind or config that does not fit."""
        self.check_spaces(spaces)
        if kind == "sparse" and isinstance(config, SparseInverseDynamicsConfig | None):
            return GridSparseInverseDynamics(spaces, config or SparseInverseDynamicsConfig(), generator)
        if kind == "dense" and isinstance(config, DenseInverseDynamicsConfig | None):
            return GridDenseInverseDynamics(spaces, config or DenseInverseDynamicsConfig(), generator)
        if kind == "masked" and isinstance(config, MaskedInverseDynamicsConfig | None):
            config = config or MaskedInverseDynamicsConfig()
            if config.over == "cells":
                return GridCellMaskedInverseDynamics(spaces, config, generator)
            return GridLatentMaskedInverseDynamics(spaces, config, generator)
        names = "'sparse', 'dense' or 'masked'"
        raise ValueError(f"Grid inverse dynamics is {names} with its config, got {kind!r} and {config}.")

    def build_subgoal_generator(
        self, spaces: Spaces, config: GridSubgoalGeneratorConfig | None, generator: torch.Generator
    ) -> GridSubgoalGenerator:
        """All parameters are drawn from `generator`."""
        self.check_spaces(spaces)
        return GridSubgoalGenerator(spaces, config or GridSubgoalGeneratorConfig(), generator)

    def build(self, kind: str, spaces: Spaces, config: Mapping[str, Any], generator: torch.Generator) -> Network:
        """Raises ValueError for another kind, TypeError for a config with other fields."""
        match kind:
            case "world_model":
                return self.build_world_model(spaces, GridWorldModelConfig(**config), generator)
            case "inverse_dynamics":
                sparse = SparseInverseDynamicsConfig(**config)
                return self.build_inverse_dynamics(spaces, "sparse", sparse, generator)
            case "dense_inverse_dynamics":
                dense = DenseInverseDynamicsConfig(**config)
                return self.build_inverse_dynamics(spaces, "dense", dense, generator)
            case "masked_inverse_dynamics":
                masked = MaskedInverseDynamicsConfig(**config)
                return self.build_inverse_dynamics(spaces, "masked", masked, generator)
            case "subgoal_generator":
                return self.build_subgoal_generator(spaces, GridSubgoalGeneratorConfig(**config), generator)
        raise ValueError(f"The grid family builds {', '.join(KINDS)}; got {kind!r}.")

    def training_config(self, kind: str, segments: int) -> TrainingConfig:
        """One schedule a kind, the same for every strategy."""
        match kind:
            case "world_model":
                steps = min(3000, max(600, 3 * segments))  # more labels are worth more passes over them
                return TrainingConfig(steps=steps, batch_size=32, learning_rate=1e-2, weight_decay=0.5)
            case "inverse_dynamics":
                return TrainingConfig(steps=400, batch_size=64, learning_rate=5e-3, weight_decay=1e-4)
            case "dense_inverse_dynamics":
                # It sees whole frames: with the sparse form's 400 steps it is still far from what it can learn.
                steps = min(1600, max(800, 3 * segments))
                return TrainingConfig(steps=steps, batch_size=64, learning_rate=3e-3, weight_decay=1e-3)
            case "masked_inverse_dynamics":
                return TrainingConfig(steps=800, batch_size=64, learning_rate=5e-3, weight_decay=1e-4)
            case "subgoal_generator":
                return TrainingConfig(steps=1500, batch_size=64, learning_rate=5e-3, weight_decay=1e-4)
        raise ValueError(f"The grid family trains {', '.join(KINDS)}; got {kind!r}.")

    def further_config(self, kind: str, segments: int) -> None:
        """From scratch, so that a round's models depend on its labels alone and not on how they came in."""
        self.training_config(kind, segments)  # refuses an unknown kind


@dataclass(frozen=True)
class RobotPreset:
    """What the networks of robots are built and trained by where nothing else is said, kind by kind.

    gates: the inverse dynamics with a learned mask. The dense form is the sparse one without its price. further: the
    schedules of later rounds, from the weights of the round before.
    """

    world_model: RecurrentWorldModelConfig
    latent_action: LatentActionConfig
    gates: LatentGatesConfig
    subgoals: LatentSubgoalGeneratorConfig
    training: Mapping[str, TrainingConfig]
    further: Mapping[str, TrainingConfig]


_SMALL = RobotPreset(
    recurrent.SMALL,
    latent_action.SMALL,
    latent_gates.SMALL,
    latent.SMALL,
    {
        "world_model": TrainingConfig(1200, 8, 1e-3, 0.0, clip=100.0),
        "inverse_dynamics": TrainingConfig(800, 16, 3e-3, 1e-2),
        "dense_inverse_dynamics": TrainingConfig(800, 16, 3e-3, 1e-2),
        "masked_inverse_dynamics": TrainingConfig(800, 32, 1e-2, 1e-2),
        "subgoal_generator": TrainingConfig(1500, 32, 3e-3, 1e-4),
    },
    {
        "world_model": TrainingConfig(400, 8, 5e-4, 0.0, clip=100.0),
        "inverse_dynamics": TrainingConfig(270, 16, 1e-3, 1e-2),
        "dense_inverse_dynamics": TrainingConfig(270, 16, 1e-3, 1e-2),
        "masked_inverse_dynamics": TrainingConfig(270, 32, 3e-3, 1e-2),
        "subgoal_generator": TrainingConfig(500, 32, 1e-3, 1e-4),
    },
)
_PAPER = RobotPreset(
    recurrent.PAPER,
    latent_action.PAPER,
    latent_gates.PAPER,
    latent.PAPER,
    {
        "world_model": TrainingConfig(200_000, 16, 1e-4, 0.0, warm_up=0.0, clip=1000.0, constant=True),
        "inverse_dynamics": TrainingConfig(200_000, 64, 3e-4, 1e-3, warm_up=0.0, constant=True),
        "dense_inverse_dynamics": TrainingConfig(200_000, 64, 3e-4, 1e-3, warm_up=0.0, constant=True),
        "masked_inverse_dynamics": TrainingConfig(50_000, 64, 3e-4, 1e-3, warm_up=0.0, constant=True),
        "subgoal_generator": TrainingConfig(200_000, 64, 3e-4, 1e-4),
    },
    {
        "world_model": TrainingConfig(50_000, 16, 1e-4, 0.0, warm_up=0.0, clip=1000.0, constant=True),
        "inverse_dynamics": TrainingConfig(50_000, 64, 3e-4, 1e-3, warm_up=0.0, constant=True),
        "dense_inverse_dynamics": TrainingConfig(50_000, 64, 3e-4, 1e-3, warm_up=0.0, constant=True),
        "masked_inverse_dynamics": TrainingConfig(50_000, 64, 3e-4, 1e-3, warm_up=0.0, constant=True),
        "subgoal_generator": TrainingConfig(50_000, 64, 3e-4, 1e-4),
    },
)


@dataclass(frozen=True)
class RobotFamily:
    """Robots: camera images and vectors of numbers, actions in a box.

    preset: small, for hours of two processor cores, or the paper's, which trains as the paper does.
    """

    preset: RobotPreset = _SMALL
    name: str = "robot"

    def check_spaces(self, spaces: Spaces) -> None:
        """Raises ValueError, in a sentence, for spaces other than the family's."""
        check_robot_spaces(spaces)

    def build_world_model(
        self, spaces: Spaces, config: RecurrentWorldModelConfig | None, generator: torch.Generator
    ) -> RecurrentWorldModel:
        """All parameters are drawn from `generator`."""
        return RecurrentWorldModel(spaces, config or self.preset.world_model, generator)

    def build_inverse_dynamics(
        self,
        spaces: Spaces,
        kind: InverseKind,
        config: LatentActionConfig | LatentGatesConfig | None,
        generator: torch.Generator,
    ) -> InverseDynamics:
        """All parameters are drawn from `generator`. Raises ValueError for a kind or config that does not fit."""
        if kind == "masked" and isinstance(config, LatentGatesConfig | None):
            return LatentMaskedInverseDynamics(spaces, config or self.preset.gates, generator)
        if isinstance(config, LatentActionConfig | None):
            config = config or (self.preset.latent_action if kind == "sparse" else self._dense())
            if (kind == "sparse") == (config.sparsity > 0.0):
                return LatentActionInverseDynamics(spaces, config, generator)
        names = "'sparse', 'dense' or 'masked'"
        raise ValueError(f"Robot inverse dynamics is {names} with its config, got {kind!r} and {config}.")

    def build_subgoal_generator(
        self, spaces: Spaces, config: LatentSubgoalGeneratorConfig | None, generator: torch.Generator
    ) -> LatentSubgoalGenerator:
        """All parameters are drawn from `generator`."""
        return LatentSubgoalGenerator(spaces, config or self.preset.subgoals, generator)

    def build(self, kind: str, spaces: Spaces, config: Mapping[str, Any], generator: torch.Generator) -> Network:
        """Raises ValueError for another kind, TypeError for a config with other fields."""
        match kind:
            case "world_model":
                return self.build_world_model(spaces, replace(self.preset.world_model, **config), generator)
            case "inverse_dynamics":
                sparse = replace(self.preset.latent_action, **config)
                return self.build_inverse_dynamics(spaces, "sparse", sparse, generator)
            case "dense_inverse_dynamics":
                return self.build_inverse_dynamics(spaces, "dense", replace(self._dense(), **config), generator)
            case "masked_inverse_dynamics":
                return self.build_inverse_dynamics(spaces, "masked", replace(self.preset.gates, **config), generator)
            case "subgoal_generator":
                return self.build_subgoal_generator(spaces, replace(self.preset.subgoals, **config), generator)
        raise ValueError(f"The robot family builds {', '.join(KINDS)}; got {kind!r}.")

    def training_config(self, kind: str, segments: int) -> TrainingConfig:
        """One schedule a kind, the same for every strategy and any number of segments."""
        return self._of(self.preset.training, kind)

    def further_config(self, kind: str, segments: int) -> TrainingConfig:
        """A shorter schedule, as in the paper: every round adds to what the one before has learned."""
        return self._of(self.preset.further, kind)

    @staticmethod
    def _of(schedules: Mapping[str, TrainingConfig], kind: str) -> TrainingConfig:
        if kind not in schedules:
            raise ValueError(f"The robot family trains {', '.join(KINDS)}; got {kind!r}.")
        return schedules[kind]

    def _dense(self) -> LatentActionConfig:
        return replace(self.preset.latent_action, sparsity=0.0)


GRID = GridFamily()
ROBOT = RobotFamily()
ROBOT_PAPER = RobotFamily(_PAPER)
FAMILIES: dict[str, Family] = {family.name: family for family in (GRID, ROBOT)}
PRESETS: dict[str, dict[str, Family]] = {"robot": {"small": ROBOT, "paper": ROBOT_PAPER}}  # its default is the first


def family_named(name: str, preset: str | None = None) -> Family:
    """The family in its default preset or in another; a preset says only what new networks are built and trained by.

    Raises ValueError, in a sentence, for a name that is not in FAMILIES or a preset that the family does not have.
    """
    if name not in FAMILIES:
        raise ValueError(f"family must be one of {', '.join(FAMILIES)}, got {name!r}.")
    if preset is None:
        return FAMILIES[name]
    known = PRESETS.get(name, {})
    if preset not in known:
        raise ValueError(f"preset of the {name} family must be one of {', '.join(known) or 'none'}, got {preset!r}.")
    return known[preset]
