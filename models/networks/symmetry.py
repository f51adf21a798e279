"""What a room and the same room turned by quarters have in common: everything but the way they face.

No rule of a grid world in MiniGrid's code knows which way is up, and no action's meaning changes when the whole room is
turned, the agent's direction included. Networks with coordinates and 3x3 filters would have to learn that four times
over; so each training segment is turned at random, all of its frames alike.
"""

from dataclasses import replace

import torch
from torch import Tensor

from models.networks.grid import AGENT, FORWARD
from models.segments import SegmentBatch, concatenate

DIRECTIONS = len(FORWARD)


def turned(batch: SegmentBatch, generator: torch.Generator) -> SegmentBatch:
    """Each segment turned clockwise by a random number of quarters; its actions stay what they are."""
    quarters = torch.randint(DIRECTIONS, (batch.size,), generator=generator, device=generator.device)
    grid = turn(batch.observations["grid"], quarters.to(batch.observations["grid"].device))
    return replace(batch, observations={**batch.observations, "grid": grid})


def every_turn(batch: SegmentBatch) -> SegmentBatch:
    """All segments in each of the four turns: all that `turned` may make of them, (B,) -> (4*B,)."""
    grid = batch.observations["grid"]
    turns = [turn(grid, torch.full((batch.size,), count, device=grid.device)) for count in range(DIRECTIONS)]
    return concatenate([replace(batch, observations={**batch.observations, "grid": each}) for each in turns])


def turn(grid: Tensor, quarters: Tensor) -> Tensor:
    """grid uint8 (B, T, S, S, 3) turned clockwise by quarters int64 (B,) of a turn: cells move, the agent's direction
    (right, down, left, up) goes on."""
    every = torch.stack([grid.rot90(-count, (2, 3)) for count in range(DIRECTIONS)])  # (4, B, T, S, S, 3)
    moved = every[quarters, torch.arange(len(grid), device=grid.device)]
    agent = moved[..., 0] == AGENT
    direction = (moved[..., 2] + quarters.view(-1, 1, 1, 1)) % DIRECTIONS
    moved[..., 2] = torch.where(agent, direction.to(moved.dtype), moved[..., 2])
    return moved
