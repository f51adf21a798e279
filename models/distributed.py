"""Training one network in several processes, each on its share of every minibatch."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from models.network import Network
from models.segments import SegmentBatch
from models.spaces import Spaces


class DistributedNetwork:
    """A network whose loss reads this process's share of a batch and whose gradient is the mean over all processes.

    `advance` trains it like any other, in every process of the group with the same dataset, state and device kind: all
    draw the same minibatches, take the same steps and hold the same weights. Buffers are those of the first process.
    """

    def __init__(self, network: Network) -> None:
        self.network = network
        self._parallel: DistributedDataParallel | None = None  # not before the network is on its device

    @property
    def family(self) -> str:
        """The network's."""
        return self.network.family

    @property
    def kind(self) -> str:
        """The network's."""
        return self.network.kind

    @property
    def spaces(self) -> Spaces:
        """The network's."""
        return self.network.spaces

    @property
    def config(self) -> Any:
        """The network's."""
        return self.network.config

    def check(self, batch: SegmentBatch) -> None:
        """The network's."""
        self.network.check(batch)

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """The network's on every n-th segment; its value is the mean over the processes, on all of them the same.

        Where the batch does not give each process equally many segments, those of a smaller share count more.
        """
        processes, rank = distributed.get_world_size(), distributed.get_rank()
        seed = int(torch.randint(2**62, (), generator=generator)) + rank  # every process draws this, and then its own
        share = batch.take(slice(rank, None, processes))
        loss: Tensor = self._wrapped()(share, torch.Generator().manual_seed(seed))
        mean = loss.detach().clone()
        distributed.all_reduce(mean)
        return loss + (mean / processes - loss.detach())

    def named_parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        """The network's."""
        return self.network.named_parameters()

    def state_dict(self) -> dict[str, Any]:
        """The network's."""
        return self.network.state_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any], /) -> Any:
        """The network's."""
        return self.network.load_state_dict(state_dict)

    def to(self, device: torch.device | str, /) -> Any:
        """Moves the network."""
        return self.network.to(device)

    def _wrapped(self) -> DistributedDataParallel:
        if self._parallel is None:
            self._parallel = DistributedDataParallel(_Loss(self.network))
        return self._parallel


class _Loss(nn.Module):
    """A network's loss as what DistributedDataParallel takes: a module's forward."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        assert isinstance(network, nn.Module)  # noqa: S101  # all of ours are
        self.network = network

    def forward(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        loss: Tensor = self.network.loss(batch, generator)
        return loss
