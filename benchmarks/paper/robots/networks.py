"""Networks kept in files: one that is there is not trained again, one whose training was stopped goes on with it."""

import time
from pathlib import Path

import torch

from benchmarks.paper.runs import write_at_once
from models import checkpoints
from models.network import Network, SemiSupervised
from models.segments import SegmentBatch
from models.training import TrainingConfig, TrainingState, advance, begin

SLICE = 100  # steps between two looks at the clock
SAVED_EVERY = 300.0  # seconds


def load(path: Path, device: torch.device | str) -> Network:
    """A trained network."""
    network = checkpoints.load(path.read_bytes())
    network.to(device)
    return network


def trained(
    network: Network,
    labeled: SegmentBatch,
    action_free: SegmentBatch,
    config: TrainingConfig,
    generator: torch.Generator,
    device: torch.device | str,
    path: Path,
) -> Network:
    """Trains in place, from where a training into the same file was stopped; what it came to is in the file then.

    action_free: for networks that learn from it beside the labels.
    """
    stopped = path.with_suffix(".training")
    state = TrainingState.from_bytes(stopped.read_bytes()) if stopped.exists() else begin(network, config, generator)
    beside, saved = action_free if isinstance(network, SemiSupervised) else None, time.monotonic()
    while state.step < config.steps:
        state = advance(network, labeled, state, min(config.steps, state.step + SLICE), device, action_free=beside)
        if time.monotonic() - saved > SAVED_EVERY:
            write_at_once(stopped, state.to_bytes())
            saved = time.monotonic()
    write_at_once(path, checkpoints.save(network))
    stopped.unlink(missing_ok=True)
    return network
