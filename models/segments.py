"""Segments of trajectories, and batches of them as named tensors with stated shapes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

Observations = dict[str, Tensor]


class Segment(NamedTuple):
    """A window of a trajectory: `start` is the index of its first observation."""

    trajectory: str
    start: int


@dataclass(frozen=True)
class SegmentBatch:
    """B segments of L transitions each.

    observations: stream name -> (B, L+1, ...), in the dtype of the space.
    actions: (B, L) int64 for discrete actions, (B, L, D) float for continuous ones, None where there are no labels.
    action_sets: (B, L, n_actions) bool, all actions that explain a step; None where only `actions` is known.
    segments: the B names, for messages; may be left empty.
    """

    observations: Observations
    actions: Tensor | None = None
    action_sets: Tensor | None = None
    segments: tuple[Segment, ...] = ()

    def __post_init__(self) -> None:
        if not self.observations:
            raise ValueError("A segment batch needs at least one observation stream, got none.")
        shapes = {name: tuple(stream.shape[:2]) for name, stream in self.observations.items()}
        if len(set(shapes.values())) != 1:
            raise ValueError(f"Streams of a segment batch must agree in (segments, observations), got {shapes}.")
        self._check_labels("actions", self.actions)
        self._check_labels("action_sets", self.action_sets)
        if self.segments and len(self.segments) != self.size:
            raise ValueError(f"segments names {len(self.segments)} segments, the batch holds {self.size}.")

    def _check_labels(self, field: str, labels: Tensor | None) -> None:
        if labels is not None and tuple(labels.shape[:2]) != (self.size, self.length):
            expected = (self.size, self.length)
            raise ValueError(f"{field} must begin with (segments, steps) = {expected}, got {tuple(labels.shape)}.")

    @property
    def size(self) -> int:
        """Number of segments B."""
        return int(next(iter(self.observations.values())).shape[0])

    @property
    def length(self) -> int:
        """Transitions in each segment, L."""
        return int(next(iter(self.observations.values())).shape[1]) - 1

    def to(self, device: torch.device | str) -> "SegmentBatch":
        """The same batch on `device`."""
        return replace(
            self,
            observations={name: stream.to(device) for name, stream in self.observations.items()},
            actions=None if self.actions is None else self.actions.to(device),
            action_sets=None if self.action_sets is None else self.action_sets.to(device),
        )

    def take(self, indices: Tensor | slice) -> "SegmentBatch":
        """The segments at `indices` (int64, any length) or in a slice, in that order."""
        return replace(
            self,
            observations={name: stream[indices] for name, stream in self.observations.items()},
            actions=None if self.actions is None else self.actions[indices],
            action_sets=None if self.action_sets is None else self.action_sets[indices],
            segments=self._names(indices),
        )

    def name(self, row: int) -> str:
        """Segment `row` as messages name it."""
        return f"{self.segments[row].trajectory}:{self.segments[row].start}" if self.segments else f"row {row}"

    def _names(self, indices: Tensor | slice) -> tuple[Segment, ...]:
        if not self.segments or isinstance(indices, slice):
            return self.segments[indices] if isinstance(indices, slice) else ()
        return tuple(self.segments[int(index)] for index in indices)

    def transitions(self) -> "SegmentBatch":
        """Every transition as a segment of length 1: (B, L) -> (B*L, 1)."""
        if self.length == 1:
            return self
        pairs = {name: torch.stack((stream[:, :-1], stream[:, 1:]), 2) for name, stream in self.observations.items()}
        names = (Segment(name.trajectory, name.start + step) for name in self.segments for step in range(self.length))
        return SegmentBatch(
            observations={name: pair.flatten(0, 1) for name, pair in pairs.items()},  # (B, L, 2, ...) -> (B*L, 2, ...)
            actions=None if self.actions is None else self.actions.flatten(0, 1).unsqueeze(1),
            action_sets=None if self.action_sets is None else self.action_sets.flatten(0, 1).unsqueeze(1),
            segments=tuple(names),
        )

    def windows(self, length: int, generator: torch.Generator) -> "SegmentBatch":
        """Of each segment `length` transitions in a row, from a start of its own drawn by the generator.

        Segments that are no longer stay whole. Raises ValueError for a batch with action sets.
        """
        if self.length <= length:
            return self
        if self.action_sets is not None:
            raise ValueError("Windows are cut from segments of continuous actions; the batch carries action sets.")
        starts = torch.randint(self.length - length + 1, (self.size, 1), generator=generator, device=generator.device)
        named = zip(self.segments, starts, strict=False)  # names may be left empty
        every, steps = torch.arange(self.size).unsqueeze(1), starts.cpu() + torch.arange(length + 1)  # (B, length+1)
        return SegmentBatch(
            observations={name: stream[every, steps] for name, stream in self.observations.items()},
            actions=None if self.actions is None else self.actions[every, steps[:, :-1]],
            segments=tuple(Segment(name.trajectory, name.start + int(at)) for name, at in named),
        )

    def with_drawn_actions(self, generator: torch.Generator) -> "SegmentBatch":
        """The same segments, each step's action one of its set, all equally likely: all of them are true.

        Without action sets the actions stay.
        """
        if self.action_sets is None:
            return self
        draw = torch.rand(self.action_sets.shape, generator=generator, device=generator.device)
        return replace(self, actions=(draw.to(self.action_sets.device) * self.action_sets).argmax(-1))

    def explanations(self, count: int) -> Tensor:
        """The actions that explain each step, of `count`: bool (B, L, count), the label's set, else its action alone.

        Raises ValueError for a batch without actions.
        """
        if self.action_sets is not None:
            return self.action_sets
        if self.actions is None:
            raise ValueError("Which actions explain a step only labels tell; the batch carries no actions.")
        return torch.nn.functional.one_hot(self.actions, count).bool()

    def without_labels(self) -> "SegmentBatch":
        """The observations alone, as who infers the actions may see them."""
        return SegmentBatch(self.observations, segments=self.segments)


def concatenate(batches: Sequence[SegmentBatch]) -> SegmentBatch:
    """One batch of all segments, in order.

    Where only some batches carry action sets, an action stands for the set that holds it alone. Raises ValueError when
    only some batches carry actions.
    """
    if not batches:
        raise ValueError("concatenate needs at least one segment batch, got none.")
    labeled = [batch.actions for batch in batches if batch.actions is not None]
    if len(labeled) not in (0, len(batches)):
        raise ValueError(f"{len(labeled)} of {len(batches)} segment batches carry actions; all or none must.")
    names = tuple(name for batch in batches for name in batch.segments)
    return SegmentBatch(
        observations={
            name: torch.cat([batch.observations[name] for batch in batches]) for name in batches[0].observations
        },
        actions=torch.cat(labeled) if labeled else None,
        action_sets=_concatenate_sets(batches),
        segments=names if len(names) == sum(batch.size for batch in batches) else (),
    )


def _concatenate_sets(batches: Sequence[SegmentBatch]) -> Tensor | None:
    known = [batch.action_sets for batch in batches if batch.action_sets is not None]
    if not known:
        return None
    count = int(known[0].shape[-1])
    return torch.cat([batch.explanations(count) for batch in batches])


def first(observations: Observations) -> Observations:
    """The first observation as a sequence of one: (B, L+1, ...) -> (B, 1, ...)."""
    return {name: stream[:, :1] for name, stream in observations.items()}


def at(observations: Observations, step: int) -> Observations:
    """One observation of each segment: (B, L+1, ...) -> (B, ...)."""
    return {name: stream[:, step] for name, stream in observations.items()}


def take(observations: Observations, rows: Tensor) -> Observations:
    """Some of (B, ...): int64 places."""
    return {name: stream[rows] for name, stream in observations.items()}


def future(observations: Observations) -> Observations:
    """All observations but the first: (B, L+1, ...) -> (B, L, ...)."""
    return {name: stream[:, 1:] for name, stream in observations.items()}
