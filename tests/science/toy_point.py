"""A point that its action moves, a finger that its action opens or closes, and distractors that move as they like.

proprioception (3,): x, y, finger (0 or 1). objects (6,): the distractors. Actions (3,): how far the point goes, in
tenths, and a sign that sets the finger. In labeled data the distractors go along with the point, most of the time.
"""

import torch
from torch import Tensor

from models.segments import Segment, SegmentBatch
from models.spaces import BoxAction, Spaces, StreamSpec

SPACES = Spaces(
    {"proprioception": StreamSpec((3,), "float32"), "objects": StreamSpec((6,), "float32")},
    BoxAction(-1.0, 1.0, (3,), (2,)),
)
STEP, DISTRACTORS = 0.1, 6


def segments(count: int, length: int, seed: int, together: float, labels: bool = True) -> SegmentBatch:
    """`count` segments of `length` steps; together: how much of a distractor's way is the point's own, 0 to 1."""
    generator = torch.Generator().manual_seed(seed)
    actions = 2 * torch.rand(count, length, 3, generator=generator) - 1
    point = torch.randn(count, 1, 2, generator=generator)
    finger = (torch.rand(count, 1, 1, generator=generator) < 0.5).float()
    own = 2 * torch.rand(count, length, DISTRACTORS, generator=generator) - 1
    way = together * actions[..., :2].repeat(1, 1, 3) + (1 - together) * own
    objects = torch.randn(count, 1, DISTRACTORS, generator=generator)
    return SegmentBatch(
        {
            "proprioception": torch.cat((_path(point, actions[..., :2]), _fingers(finger, actions)), 2),
            "objects": _path(objects, way),
        },
        actions if labels else None,
        segments=tuple(Segment(f"point-{seed}", start) for start in range(count)),
    )


def _path(start: Tensor, ways: Tensor) -> Tensor:
    """(B, 1, D), (B, L, D) -> (B, L+1, D)."""
    return torch.cat((start, start + STEP * ways.cumsum(1)), 1)


def _fingers(first: Tensor, actions: Tensor) -> Tensor:
    return torch.cat((first, (actions[..., 2:] > 0).float()), 1)
