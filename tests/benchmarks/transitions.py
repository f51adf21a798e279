"""Labeled transitions of the simulator, without files."""

import numpy as np
import torch

from models.segments import SegmentBatch
from workers.episodes import new_episodes
from workers.simulators.catalog import make_behavior, make_simulator


def transitions(behavior: str, count: int, seed: int) -> SegmentBatch:
    """`count` steps of 6x6 rooms with the actions that were taken; no action sets."""
    simulator = make_simulator("minigrid", {})
    episodes = list(new_episodes(simulator, make_behavior(behavior, simulator), count, seed))
    pairs = {
        name: np.concatenate(
            [np.stack((each.observations[name][:-1], each.observations[name][1:]), 1) for each in episodes]
        )
        for name in ("grid", "carried")
    }
    actions = torch.tensor([[action] for each in episodes for action in each.actions])
    return SegmentBatch({name: torch.from_numpy(pair) for name, pair in pairs.items()}, actions)
