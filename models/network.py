"""What training, checkpoints and the registry need of a network, whatever its kind."""

from collections.abc import Iterator, Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from models.segments import SegmentBatch
from models.spaces import Spaces

KINDS = (
    "world_model",
    "inverse_dynamics",
    "dense_inverse_dynamics",
    "masked_inverse_dynamics",
    "subgoal_generator",
)


class Network(Protocol):
    """A trainable network that knows its family, its kind (one of KINDS), its spaces and its config (a dataclass)."""

    @property
    def family(self) -> str: ...

    @property
    def kind(self) -> str: ...

    @property
    def spaces(self) -> Spaces: ...

    @property
    def config(self) -> Any: ...

    def check(self, batch: SegmentBatch) -> None:
        """Raises ValueError for observations outside the spaces."""
        ...

    def loss(self, batch: SegmentBatch, generator: torch.Generator) -> Tensor:
        """Scalar training loss; every draw comes from the generator."""
        ...

    def named_parameters(self) -> Iterator[tuple[str, nn.Parameter]]: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state_dict: Mapping[str, Any], /) -> Any: ...

    def to(self, device: torch.device | str, /) -> Any: ...


@runtime_checkable
class SemiSupervised(Protocol):
    """A network that learns from action-free segments beside the labeled ones, where there are any."""

    def semi_supervised_loss(
        self, labeled: SegmentBatch, action_free: SegmentBatch, generator: torch.Generator
    ) -> Tensor:
        """Scalar training loss; the segments of both batches have one length."""
        ...
