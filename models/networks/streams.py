"""What networks of robots refuse."""

from models.segments import SegmentBatch


def check_finite(batch: SegmentBatch) -> None:
    """Raises ValueError naming stream (or actions) and segment of the first number that is not finite."""
    streams = dict(batch.observations) if batch.actions is None else {**batch.observations, "actions": batch.actions}
    for name, stream in streams.items():
        if not stream.is_floating_point():
            continue
        bad = (~stream.isfinite()).flatten(1).any(1).nonzero().flatten().tolist()
        if bad:
            raise ValueError(f"{name} of segment {batch.name(bad[0])} holds a number that is not finite.")
