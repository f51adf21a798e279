"""Which rooms figure 4d is about: the project's own, or files in the foreign layout in place of parts of them."""

import argparse
import hashlib
import json
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

from torch.nn.functional import one_hot

from benchmarks.paper.minigrid import foreign
from benchmarks.paper.minigrid.action_following import Outcomes, load_outcomes
from benchmarks.paper.minigrid.datasets import ACTIONS, REPORTED, TUNING, DataSpec, draw_test_labels, grid_spaces, load
from benchmarks.paper.runs import code_digest
from models.segments import SegmentBatch
from models.spaces import Spaces

MOST_DATA_SEEDS = 10_000  # ten layout seeds each, below the first room of figure 4a
FILES = {
    "test_set": "in place of both tests",
    "pool": "in place of the pool",
    "seed_set": "the first labels, which are else drawn from the pool",
    "video": "for the subgoal generator, which else trains on the pool's observations",
}


@dataclass(frozen=True)
class Data:
    """pool: with the hidden action sets. tests: by name. seed_set, video: None where they come from the pool.

    outcomes: for the action-following score; None where the rooms are a file's, in which nothing can be tried out.
    """

    pool: SegmentBatch
    tests: dict[str, SegmentBatch]
    seed_set: SegmentBatch | None
    video: SegmentBatch | None
    outcomes: Outcomes | None

    @property
    def spaces(self) -> Spaces:
        """Of the pool's rooms."""
        return grid_spaces(int(self.pool.observations["grid"].shape[2]))


@dataclass(frozen=True)
class Rooms:
    """The reported rooms or those for tuning; `data_seed` chooses among either. Files stand in for parts of them.

    All layouts of a test are of other seeds than the pool's.
    """

    folder: Path
    tuning: bool = False
    data_seed: int = 0
    pool_transitions: int = 28_000
    per_action: int = 500
    natural_transitions: int = 6000
    test_set: Path | None = None
    pool: Path | None = None
    seed_set: Path | None = None
    video: Path | None = None

    @classmethod
    def of(cls, asked: argparse.Namespace) -> "Rooms":
        """From the options that `add_options` and `add_files` add."""
        files = {name: getattr(asked, name) for name in FILES}
        return cls(asked.out / "data", asked.tuning, asked.data_seed, **files)

    @property
    def words(self) -> tuple[str, ...]:
        """What sets results on these rooms apart from those on others."""
        return ("tuning" if self.tuning else "reported", self.identity)

    @property
    def identity(self) -> str:
        """A digest of all that decides what the rooms hold, files by their content: what is kept for them bears it."""
        told = {name: value for name, value in asdict(self).items() if name != "folder"}
        for name in FILES:
            path: Path | None = told[name]
            told[name] = None if path is None else foreign.digest(path)
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:12]

    def networks(self, out: Path) -> Path:
        """The folder of the networks that all arms share here: other rooms and other code train others."""
        return out / "networks" / f"{self.identity}-{code_digest()}"

    def load(self) -> Data:
        """From files, made where they are not there yet."""
        return _load(self)

    @property
    def pool_spec(self) -> DataSpec:
        """What the project's own pool is made of."""
        return self.spec(1, "mixture", self.pool_transitions)

    def spec(self, number: int, behavior: str, transitions: int, per_action: int = 0) -> DataSpec:
        """Set `number` of these rooms."""
        first = (TUNING if self.tuning else REPORTED) + 10 * self.data_seed
        return DataSpec(behavior, transitions, first + number, per_action=per_action)


def add_files(parser: argparse.ArgumentParser) -> None:
    """Options for which rooms, and for files in the foreign layout."""
    parser.add_argument("--data-seed", type=data_seed, default=0, help=f"other rooms, 0 to {MOST_DATA_SEEDS - 1}")
    for name, what in FILES.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=Path, help=f"npz of transitions, {what}")


def data_seed(text: str) -> int:
    """From the command line. Beyond the bound lie the rooms of other figures, further on those for tuning."""
    if not text.isdecimal() or int(text) >= MOST_DATA_SEEDS:
        raise argparse.ArgumentTypeError(f"must be 0 to {MOST_DATA_SEEDS - 1}, got {text!r}")
    return int(text)


@cache
def _load(rooms: Rooms) -> Data:
    """Once a process."""
    pool = _foreign(rooms.pool) or load(rooms.pool_spec, rooms.folder)
    ours = rooms.pool is None and rooms.test_set is None
    outcomes = load_outcomes(rooms.spec(4, "balanced", 200_000, per_action=100), rooms.folder) if ours else None
    return Data(pool, _tests(rooms), _foreign(rooms.seed_set), _foreign(rooms.video), outcomes)


def _tests(rooms: Rooms) -> dict[str, SegmentBatch]:
    given = _foreign(rooms.test_set)
    if given is not None:
        return {"balanced": given, "natural": given}
    balanced = load(rooms.spec(2, "balanced", 200_000, rooms.per_action), rooms.folder)
    natural = load(rooms.spec(3, "mixture", rooms.natural_transitions), rooms.folder)
    return {"balanced": draw_test_labels(balanced), "natural": draw_test_labels(natural)}


def _foreign(path: Path | None) -> SegmentBatch | None:
    """Such a file knows one action of each step; that others explain it too is not known there."""
    if path is None:
        return None
    batch = foreign.read(path)
    assert batch.actions is not None
    return replace(batch, action_sets=one_hot(batch.actions, ACTIONS).bool())
