"""The standing of a collection: what it has drawn and labeled, kept after each stored batch.

Another attempt goes on from it behind that batch, and stores what an uninterrupted run would have.
"""

import json
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from api_schemas.jobs import Collect
from service.store import codec
from service.store.errors import ForeignFile
from workers.episodes import DIGEST, Drawn
from workers.simulators.base import Behavior, RememberingBehavior

VERSION = 1  # of the format, and of how episodes follow from a generator's state


@dataclass
class Standing:
    """labels: taken so far, by what the quota counts by. memory: of a behavior that remembers more than its episode."""

    drawn: Drawn
    labels: Counter[str] = field(default_factory=Counter)
    memory: list[int] | None = None
    _behavior: RememberingBehavior | None = None

    @classmethod
    def of_beginning(cls, asked: Collect) -> "Standing":
        """Nothing is drawn. A collection in one piece draws from its seed's own stream, each shard from another."""
        spawned = () if asked.shard is None else (asked.shard,)
        return cls(Drawn(np.random.default_rng(np.random.SeedSequence(asked.collection.seed, spawn_key=spawned))))

    def follow(self, behavior: Behavior) -> None:
        """The behavior goes on from its memory, and is asked for it from here on."""
        if isinstance(behavior, RememberingBehavior):
            if self.memory is not None:
                behavior.recall(self.memory)
            self._behavior = behavior

    def to_bytes(self, job: str, asked: Collect) -> bytes:
        """A checkpoint of this job, whose bytes no other has."""
        drawn = self.drawn
        seen = np.frombuffer(b"".join(sorted(drawn.seen)), np.uint8).reshape(-1, DIGEST)  # (trajectories, DIGEST)
        told = {
            **_identity(job, asked),
            "generator": drawn.rng.bit_generator.state,
            "trajectories": drawn.trajectories,
            "transitions": drawn.transitions,
            "labels": self.labels,
            "memory": None if self._behavior is None else self._behavior.memory,
        }
        return codec.encode({"seen": seen}, {"standing": told})

    @classmethod
    def from_bytes(cls, data: bytes, job: str, asked: Collect) -> "Standing":
        """Raises ValueError for damaged bytes, another version's, and another collection's."""
        try:
            arrays, extra = codec.decode(data, "checkpoint")
            told: dict[str, Any] = extra["standing"]
        except (ForeignFile, KeyError) as error:
            raise ValueError(f"it is no standing of a collection: {error}") from error
        for name, value in _identity(job, asked).items():
            if told.get(name) != value:
                raise ValueError(f"its {name} is {told.get(name)}, and not {value}")
        rng = np.random.default_rng()
        rng.bit_generator.state = told["generator"]
        seen = {digest.tobytes() for digest in arrays["seen"]}
        drawn = Drawn(rng, seen, told["trajectories"], told["transitions"])
        return cls(drawn, Counter(told["labels"]), told["memory"])


def _identity(job: str, asked: Collect) -> dict[str, object]:
    return {"version": VERSION, "job": job, "asked": json.loads(asked.model_dump_json())}
