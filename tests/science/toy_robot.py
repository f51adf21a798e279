"""Robots whose rules are known: a point that an action moves, in numbers, and the same as a picture of a square."""

from dataclasses import replace

import torch
from torch import Tensor

from models.families import RobotPreset
from models.inverse_dynamics import latent_action, latent_gates
from models.segments import Observations, Segment, SegmentBatch
from models.spaces import BoxAction, Spaces, StreamSpec
from models.subgoal_generators import latent
from models.training import TrainingConfig
from models.world_models.recurrent import RecurrentWorldModel, RecurrentWorldModelConfig

STEP = 0.3  # of an action of 1; the world ends at -1 and 1
ACTION = BoxAction(-1.0, 1.0, (2,))
POINT = Spaces({"position": StreamSpec((2,), "float32")}, ACTION)
SIDE, SQUARE = 16, 4
PICTURE = Spaces({"camera": StreamSpec((SIDE, SIDE, 3), "uint8")}, ACTION)
TINY = RecurrentWorldModelConfig(
    deterministic=64,
    groups=16,
    classes=16,
    hidden=64,
    depth=8,
    units=64,
    layers=1,
    window=12,
    reads_first=True,
    standardised=True,
    numbers_weight=100.0,
)
SHORT = TrainingConfig(20, 16, 1e-2, 1e-2)
PRESET = RobotPreset(
    TINY,
    replace(latent_action.SMALL, width=16, heads=1, hidden=16, actor=(16,)),
    latent_gates.SMALL,
    latent.SMALL,
    {
        "world_model": TrainingConfig(150, 16, 1e-2, 0.0, clip=100.0),
        "inverse_dynamics": SHORT,
        "dense_inverse_dynamics": SHORT,
        "masked_inverse_dynamics": SHORT,
        "subgoal_generator": SHORT,
    },
    {
        "world_model": TrainingConfig(50, 16, 3e-3, 0.0, clip=100.0),
        **dict.fromkeys(("inverse_dynamics", "dense_inverse_dynamics", "masked_inverse_dynamics"), SHORT),
        "subgoal_generator": SHORT,
    },
)


class Standstill(RecurrentWorldModel):
    """Predicts the present for ever; its states are the observations of its only stream."""

    def infer_state(
        self, observations: Observations, actions: Tensor | None = None, context: Tensor | None = None
    ) -> Tensor:
        return next(iter(observations.values()))[:, -1]

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        return torch.stack([state] * actions.shape[1], 1)

    def observe(self, state: Tensor) -> Observations:
        return {next(iter(self.spaces.observations)): state}


def paths(count: int, length: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Positions (B, L+1, 2) and the actions (B, L, 2) that led from each to the next."""
    actions = torch.rand(count, length, 2, generator=generator) * 2 - 1
    places = [torch.rand(count, 2, generator=generator) * 2 - 1]
    for step in range(length):
        places.append((places[-1] + STEP * actions[:, step]).clamp(-1, 1))
    return torch.stack(places, 1), actions


def points(count: int, length: int, seed: int) -> SegmentBatch:
    """Labeled segments of the point."""
    position, actions = paths(count, length, torch.Generator().manual_seed(seed))
    return SegmentBatch({"position": position}, actions, segments=_names(count, seed))


def pictures(count: int, length: int, seed: int) -> SegmentBatch:
    """Labeled segments of a white square on black: its corner is at the point, to the nearest pixel."""
    position, actions = paths(count, length, torch.Generator().manual_seed(seed))
    corner = ((position + 1) / 2 * (SIDE - SQUARE)).round().unsqueeze(-1)  # (B, L+1, 2, 1)
    pixel = torch.arange(SIDE)
    covered = (pixel >= corner) & (pixel < corner + SQUARE)  # (B, L+1, 2, S)
    square = covered[:, :, 0, :, None] & covered[:, :, 1, None, :]  # (B, L+1, S, S)
    camera = square.unsqueeze(-1).expand(-1, -1, -1, -1, 3).byte() * 255
    return SegmentBatch({"camera": camera}, actions, segments=_names(count, seed))


def _names(count: int, seed: int) -> tuple[Segment, ...]:
    return tuple(Segment(f"robot-{seed}", start) for start in range(count))
