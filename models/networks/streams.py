"""What networks of robots refuse, and how much they look at together."""

from collections.abc import Iterator

from models.segments import Observations, SegmentBatch

FRAMES = 512  # looked at together where no gradient needs them all: bounds memory


def parts(observations: Observations) -> Iterator[Observations]:
    """Segments (B, T, ...) in order, about FRAMES frames at a time."""
    batch = SegmentBatch(observations)
    rows = max(1, FRAMES // (batch.length + 1))
    for start in range(0, max(1, batch.size), rows):
        yield batch.take(slice(start, start + rows)).observations


def check_finite(batch: SegmentBatch) -> None:
    """Raises ValueError naming stream (or actions) and segment of the first number that is not finite."""
    streams = dict(batch.observations) if batch.actions is None else {**batch.observations, "actions": batch.actions}
    for name, stream in streams.items():
        if not stream.is_floating_point():
            continue
        bad = (~stream.isfinite()).flatten(1).any(1).nonzero().flatten().tolist()
        if bad:
            raise ValueError(f"{name} of segment {batch.name(bad[0])} holds a number that is not finite.")
