"""What frames show, and how they differ from the frame before, both in units of what is usual."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from models.networks.image import as_bytes
from models.networks.moments import Moments
from models.networks.observation import Frame, Streams
from models.segments import Observations
from models.spaces import Spaces


class FrameChanges(nn.Module):
    """Observations (B, T, ...) -> frames (B, T, ...) and changes (B, T-1, ...), standardised by what training showed.

    A step changes little of what is seen. In units of what a step usually changes, what it does is as large as
    anything. A number has moments of its own; all pixels share theirs, since one that never changed yet may.
    """

    def __init__(self, spaces: Spaces) -> None:
        super().__init__()
        self.streams = Streams(spaces, standardised=True)
        self.pixels = Moments(1) if self.streams.cameras else None
        self.pixel_change = Moments(1) if self.streams.cameras else None
        self.number_change = Moments(self.streams.numbers) if self.streams.vectors else None

    def measure(self, observations: Observations) -> None:
        """Takes observations into account."""
        self.streams.measure(observations)
        frame = self.streams.frame(observations)
        for part, value, change in self._parts(frame):
            if value is not None:
                value.update(part.reshape(-1, 1))
            change.update(part.diff(dim=1).reshape(-1, len(change.mean)))

    def forward(self, observations: Observations) -> tuple[list[Tensor], list[Tensor]]:
        """Pixels of all cameras (B, T, S, S, C), then each vector (B, T, D), and the changes of each."""
        parts = self._parts(self.streams.frame(observations))
        values = [part if value is None else value.standardised(part) for part, value, _ in parts]
        return self._split(values), self._split([change.standardised(part.diff(dim=1)) for part, _, change in parts])

    def following(self, observations: Observations, changes: Sequence[Tensor]) -> Observations:
        """What observations (B, T, ...) become by changes of each (B, T, ...), as a simulator shows them."""
        parts, whole = self._parts(self.streams.frame(observations)), list(changes)
        if self.streams.vectors:
            vectors = len(self.streams.vectors)
            whole = [*whole[:-vectors], torch.cat(whole[-vectors:], -1)]
        after = [part + change.restored(new) for (part, _, change), new in zip(parts, whole, strict=True)]
        pixels = after.pop(0) if self.streams.cameras else None
        return as_observations(self.streams, Frame(pixels, after[0] if after else None))

    def _split(self, parts: list[Tensor]) -> list[Tensor]:
        """The numbers as the vectors they come from."""
        if not self.streams.vectors:
            return parts
        sizes = list(self.streams.vectors.values())
        vectors: tuple[Tensor, ...] = parts[-1].split(sizes, -1)  # type: ignore[no-untyped-call]  # untyped in torch
        return [*parts[:-1], *vectors]

    def _parts(self, frame: Frame) -> list[tuple[Tensor, Moments | None, Moments]]:
        """Each part of a frame, the moments that standardise it where it is not standardised yet, and its changes'."""
        parts = (frame.pixels, self.pixels, self.pixel_change), (frame.numbers, None, self.number_change)
        return [(part, value, change) for part, value, change in parts if part is not None and change is not None]


def as_observations(streams: Streams, frame: Frame) -> Observations:
    """Frames as observations: images in bytes, vectors in their units."""
    restored = streams.restored(frame)
    return {name: as_bytes(stream) if name in streams.cameras else stream for name, stream in restored.items()}
