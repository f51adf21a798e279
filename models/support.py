"""How far segments are from the labeled ones: the distance of each step to the nearest, in a description of both."""

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from models.segments import Observations, SegmentBatch

AfterEach = Callable[[], None]  # called after each chunk; may raise to stop
Describe = Callable[[Observations], Tensor]  # observations (B, L+1, ...) -> vectors (B*L, D), one a step
CHUNK = 256  # segments on either side of a table of distances, the largest of what is kept


def nearest(
    describe: Describe, batch: SegmentBatch, labeled: SegmentBatch, after_each: AfterEach = lambda: None
) -> Tensor:
    """Half the squared distance of each step to the nearest labeled step: (B*L,).

    Where vectors are one-hot codes one after the other, that is how many of the codes differ.
    """
    references = [describe(part.observations) for part in _chunks(labeled)]  # small integers stay small here
    distances = []
    for part in _chunks(batch):
        z = describe(part.observations).float()
        best = z.new_full((len(z),), torch.inf)
        for reference in references:
            best = torch.minimum(best, _half_squared(z, reference.float()).amin(1))
            after_each()
        distances.append(best)
    return torch.cat(distances)


def whole_observation(*batches: Observations) -> Describe:
    """Describes x_t and x_{t+1} by all they hold: integers one-hot, floats as they are.

    batches: what will be described; one-hot codes are as long as the largest integer of a stream in them needs.
    """
    largest = {
        name: max(int(batch[name].max()) for batch in batches)
        for name, stream in batches[0].items()
        if not stream.is_floating_point()
    }

    def describe(observations: Observations) -> Tensor:
        streams = []
        for name, stream in sorted(observations.items()):
            flat = stream.reshape(*stream.shape[:2], -1)  # (B, L+1, D)
            if name in largest:
                flat = torch.nn.functional.one_hot(flat.long(), largest[name] + 1).flatten(2).to(torch.uint8)
            streams.append(torch.cat((flat[:, :-1], flat[:, 1:]), 2).flatten(0, 1))
        return torch.cat(streams, 1)

    return describe


def _half_squared(left: Tensor, right: Tensor) -> Tensor:
    """(N, D), (M, D) -> (N, M), by one matrix product; exact for one-hot codes."""
    norms = left.square().sum(1, keepdim=True) + right.square().sum(1)
    return (norms / 2 - left @ right.t()).clamp(min=0.0)


def _chunks(batch: SegmentBatch) -> Iterator[SegmentBatch]:
    return (batch.take(slice(start, start + CHUNK)) for start in range(0, batch.size, CHUNK))
