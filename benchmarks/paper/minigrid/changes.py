"""Which elements of an observation change in a step, and how many of them a guess has right: Dynamics Accuracy."""

from collections.abc import Mapping

import torch
from torch import Tensor

from models.segments import Observations
from workers.simulators.minigrid_rules import FLOOR


def changes(guess: Observations, pairs: Observations, counted: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Guessed next observations (B, ...) of pairs (B, 2, ...) -> int64 (B,) changes guessed right, and changes.

    An element is a cell or the hand; it is right when its three channels are. counted: bool (B, S, S), the cells that
    count, None for all; the hand always counts.
    """
    correct = torch.zeros(len(guess["carried"]), dtype=torch.int64)
    changed = torch.zeros_like(correct)
    for name, stream in pairs.items():
        moved = (stream[:, 0] != stream[:, 1]).any(-1)  # (B, S, S) or (B,)
        if name == "grid" and counted is not None:
            moved = moved & counted
        right = (guess[name] == stream[:, 1]).all(-1) & moved
        correct += right.view(len(right), -1).sum(1)
        changed += moved.view(len(moved), -1).sum(1)
    return correct, changed


def without_tiles(cells: Tensor) -> Tensor:
    """The cells of rooms (B, S, S, 3), the agent not among them, that are no floor tile -> bool (B, S, S).

    A tile keeps its place and hides under the agent, so only the simulator's own cells tell them all.
    """
    return torch.ne(cells[..., 0], FLOOR)


def accuracy(correct: Tensor, changed: Tensor, groups: Mapping[str, Tensor]) -> dict[str, float | None]:
    """Pooled over the transitions of each group (bool (B,)); None where nothing changes in it."""
    pooled = {name: (int(correct[members].sum()), int(changed[members].sum())) for name, members in groups.items()}
    return {name: right / of if of else None for name, (right, of) in pooled.items()}
