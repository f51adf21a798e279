"""Where the draws of a round come from: its generators, named by what they are for.

Projects of equal seed draw alike whatever their ids, so that two arms differ in their labels only; and a benchmark that
names a draw as the service does draws the same.
"""

import zlib

import torch


def training_generator(seed: int, round_number: int, kind: str, member: int = 0) -> torch.Generator:
    """All chance of one network's training: its first weights and its minibatches."""
    return _named(f"{seed}/{round_number}/{kind}/{member}")


def scoring_generator(seed: int, strategy: str, round_number: int, trajectories: int, what: str) -> torch.Generator:
    """Chance of one part of a scoring (`what`: "shard 3", "selection 0") over a pool of so many trajectories."""
    return _named(f"{seed}/{strategy}/{round_number}/{trajectories}/{what}")


def _named(text: str) -> torch.Generator:
    return torch.Generator().manual_seed(zlib.crc32(text.encode()))
