"""Quotas: which segments of the collected episodes are labeled, and how many labels are still to come."""

from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from api_schemas.collections import CollectionLabels
from service.pool import segment_count
from workers.episodes import Episode
from workers.simulators.base import Simulator


class Quota(Protocol):
    """Takes its labels from one episode after the other. `taken` counts them, and may be set to go on from there."""

    taken: Counter[str]

    @property
    def met(self) -> bool:
        """Nothing more is wanted; never true where there is no number to reach."""

    def missing(self) -> dict[str, int]:
        """How many labels are still wanted, by the names that `taken` counts by."""

    def take(self, episode: Episode) -> list[int]:
        """Starts of the segments of this episode to label."""


def quota_of(
    asked: CollectionLabels | None, simulator: Simulator, names: Sequence[str], length: int, stride: int
) -> Quota:
    """The quota of a request. names: of the discrete actions. length, stride: of segments."""
    if asked is None:
        return SegmentQuota(length, stride, 0)
    if asked.per_action is not None:
        return ActionQuota(simulator, names, asked.per_action)
    return SegmentQuota(length, stride, asked.segments)


class ActionQuota:
    """How many effective transitions of each action are still to be labeled.

    A transition is effective when its action alone explains it: what happens by itself, like a flickering tile, has
    every idle action as an explanation.
    """

    def __init__(self, simulator: Simulator, names: Sequence[str], per_action: int) -> None:
        self._simulator, self._names, self._per_action = simulator, names, per_action
        self.taken: Counter[str] = Counter()

    @property
    def met(self) -> bool:
        """Every action has its share; never true where that is 0."""
        return self._per_action > 0 and not self.missing()

    def missing(self) -> dict[str, int]:
        """By action, how many transitions are still wanted."""
        short = {name: self._per_action - self.taken[name] for name in self._names}
        return {name: number for name, number in short.items() if number > 0}

    def take(self, episode: Episode) -> list[int]:
        """Effective transitions of actions that are still wanted."""
        starts = []
        for start, action in enumerate(episode.actions):
            name = self._names[action]
            if self.taken[name] < self._per_action and episode.explained(self._simulator, start) == [action]:
                self.taken[name] += 1
                starts.append(start)
        return starts


class SegmentQuota:
    """The first `wanted` segments; None is all there are, 0 is a collection without labels, which no number ends."""

    NAME = "segments"

    def __init__(self, length: int, stride: int, wanted: int | None) -> None:
        self._length, self._stride, self._wanted = length, stride, wanted
        self.taken: Counter[str] = Counter()

    @property
    def met(self) -> bool:
        """There are as many as were wanted."""
        return bool(self._wanted) and not self.missing()

    def missing(self) -> dict[str, int]:
        """How many segments are still wanted."""
        short = (self._wanted or 0) - self.taken[self.NAME]
        return {self.NAME: short} if short > 0 else {}

    def take(self, episode: Episode) -> list[int]:
        """The segments from the episode's beginning on."""
        count = segment_count(episode.transitions, self._length, self._stride)
        if self._wanted is not None:
            count = min(count, self._wanted - self.taken[self.NAME])
        if count:
            self.taken[self.NAME] += count
        return list(range(0, count * self._stride, self._stride))
