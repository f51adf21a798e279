"""Who takes the steps of a training: this process on one device, or one process for each of several."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from torch import nn

from models.network import Network
from models.segments import SegmentBatch
from models.training import TrainingState, advance
from workers.training_processes import TrainingProcesses

Advance = Callable[[TrainingState, int], tuple[TrainingState, float]]
"""From a state to a step: the state there, and the loss of the last step."""


@contextmanager
def trainer(
    network: Network,
    batch: SegmentBatch,
    state: TrainingState,
    devices: Sequence[str],
    action_free: SegmentBatch | None,
) -> Iterator[Advance]:
    """Begins at `state`; afterwards the network has the last state's weights.

    One device is enough for a minibatch that the devices cannot share evenly, and for a network that learns from
    action-free segments too.
    """
    shared = min(state.config.batch_size, batch.size) % len(devices) == 0 and action_free is None
    if len(devices) == 1 or not shared:
        if devices[0].startswith("cuda") and isinstance(network, nn.Module):
            network.compile()  # what a loss runs through: nothing of the weights changes
        yield partial(_here, network, batch, devices[0], action_free)
        return
    with TrainingProcesses(network, batch, state, devices) as processes:

        def together(_: TrainingState, until: int) -> tuple[TrainingState, float]:
            nonlocal state
            state, loss = processes.advance(until)
            return state, loss

        yield together
    network.load_state_dict(state.weights())


def _here(
    network: Network,
    batch: SegmentBatch,
    device: str,
    action_free: SegmentBatch | None,
    state: TrainingState,
    until: int,
) -> tuple[TrainingState, float]:
    losses = [0.0]

    def note(_: int, __: int, loss: float) -> None:
        losses.append(loss)

    state = advance(network, batch, state, until, device=device, progress=note, action_free=action_free)
    return state, losses[-1]
