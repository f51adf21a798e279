"""Sets of labeled transitions of the project's own simulator, drawn by seed and kept as files.

Every transition is explained by the labeling worker's own search (`workers.explanation`): the action that was taken is
nowhere used, a step that several actions explain carries them all.
"""

import hashlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.paper.runs import DATA, sources_digest, write_at_once
from models.segments import Segment, SegmentBatch
from models.spaces import DiscreteAction, Spaces, StreamSpec
from service.store import codec
from workers.episodes import Episode, new_episodes
from workers.quotas import ActionQuota
from workers.simulators.base import State
from workers.simulators.catalog import make_behavior, make_simulator
from workers.simulators.minigrid import ACTION_NAMES

ACTIONS = len(ACTION_NAMES)
STATE = "state."  # begins the names of state arrays in a file
GROUPS = {"movement": {0, 1, 2}, "interaction": {3, 4, 5, 6}}
REPORTED, TUNING = 2_000_000, 9_000_000
"""First layout seeds of what tables report and of what settings were chosen on; `DataSpec` refuses any in between, so
that no setting can have been chosen on a reported room."""


@dataclass(frozen=True)
class DataSpec:
    """What a set is made of. per_action 0: every transition; else so many effective ones of each action.

    states: keep the simulator's state before each transition too, for who steps the simulator.
    """

    behavior: str
    transitions: int
    seed: int
    per_action: int = 0
    room_size: int = 6
    objects: int = 3
    noisy_tiles: int = 0
    states: bool = False

    def __post_init__(self) -> None:
        check_seed(self.seed)

    @property
    def spaces(self) -> Spaces:
        """Of the observations and actions."""
        return grid_spaces(self.room_size)

    @property
    def options(self) -> dict[str, str | int | float | bool]:
        """Of the simulator."""
        return {"room_size": self.room_size, "objects": self.objects, "noisy_tiles": self.noisy_tiles}

    def file(self, folder: Path) -> Path:
        """Where the set is kept."""
        told = asdict(self) | {"code": data_digest()}
        digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]
        return folder / f"{self.behavior}-{digest}.npz"


def grid_spaces(size: int) -> Spaces:
    """Spaces of an object room, whose size counts the walls."""
    streams = {"grid": StreamSpec((size, size, 3), "uint8"), "carried": StreamSpec((3,), "uint8")}
    return Spaces(streams, DiscreteAction(ACTIONS))


def data_digest() -> str:
    """Of the code that makes sets: files of sets are named by it, so none of other code is taken for one of this."""
    return sources_digest(*DATA)


def check_seed(seed: int) -> None:
    """Raises ValueError for a seed that is neither of reported rooms nor of rooms for tuning."""
    if not REPORTED <= seed < REPORTED + 1_000_000 and seed < TUNING:
        raise ValueError(f"seed must be {REPORTED} to {REPORTED + 999_999} or from {TUNING} up, got {seed}.")


def kept(path: Path, make: Callable[[], SegmentBatch]) -> SegmentBatch:
    """The labeled transitions in the file, made where it is not there yet."""
    if not path.exists():
        batch = make()
        assert batch.actions is not None
        assert batch.action_sets is not None
        streams = {name: stream.numpy() for name, stream in batch.observations.items()}
        _save(path, {**streams, "actions": batch.actions.numpy(), "sets": batch.action_sets.numpy()})
    with np.load(path) as arrays:
        frames = {name: torch.from_numpy(arrays[name]) for name in ("grid", "carried")}
        return SegmentBatch(frames, torch.from_numpy(arrays["actions"]), torch.from_numpy(arrays["sets"]))


def load(spec: DataSpec, folder: Path) -> SegmentBatch:
    """The set, made where its file is not there yet. `actions` is the first of each step's set: `draw_labels` draws."""
    with np.load(_file(spec, folder)) as arrays:
        return _batch({name: arrays[name] for name in arrays.files if not name.startswith(STATE)})


def load_states(spec: DataSpec, folder: Path) -> list[State]:
    """The simulator's state before each transition of a set with `states`."""
    with np.load(_file(spec, folder)) as arrays:
        streams = {name.removeprefix(STATE): arrays[name] for name in arrays.files if name.startswith(STATE)}
    count = len(next(iter(streams.values())))
    return [{name: stream[row] for name, stream in streams.items()} for row in range(count)]


def _file(spec: DataSpec, folder: Path) -> Path:
    path = spec.file(folder)
    if not path.exists():
        _save(path, _made(spec))
    return path


def _save(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    write_at_once(path, packed.getvalue())


def draw_labels(batch: SegmentBatch, rng: np.random.Generator) -> SegmentBatch:
    """Label the segments as the labeling worker does: of each step's set one action by chance, in order."""
    assert batch.action_sets is not None
    drawn = [[int(rng.choice(np.flatnonzero(step))) for step in sets] for sets in batch.action_sets.numpy()]
    return SegmentBatch(batch.observations, torch.tensor(drawn), batch.action_sets, batch.segments)


def draw_test_labels(batch: SegmentBatch) -> SegmentBatch:
    """A test set's labels, the same in every run."""
    return draw_labels(batch, np.random.default_rng(0))


def _made(spec: DataSpec) -> dict[str, NDArray[np.generic]]:
    simulator = make_simulator("minigrid", spec.options)
    behavior = make_behavior(spec.behavior, simulator)
    quota = ActionQuota(simulator, ACTION_NAMES, spec.per_action)
    parts: list[tuple[Episode, Sequence[int], NDArray[np.bool_]]] = []
    for episode in new_episodes(simulator, behavior, spec.transitions, spec.seed):
        starts = quota.take(episode) if spec.per_action else range(episode.transitions)
        sets = np.zeros((len(starts), ACTIONS), np.bool_)
        for row, start in enumerate(starts):
            sets[row, episode.explained(simulator, start)] = True
        parts.append((episode, starts, sets))
        if quota.met:
            break
    simulator.close()
    if quota.missing() and spec.per_action:
        raise ValueError(
            f"{spec.transitions} transitions were too few for {spec.per_action} an action: {quota.missing()}"
        )
    return _packed(parts) | (_packed_states(parts) if spec.states else {})


def _packed(
    parts: Sequence[tuple[Episode, Sequence[int], NDArray[np.bool_]]],
) -> dict[str, NDArray[np.generic]]:
    pairs = [np.asarray(starts, np.int64)[:, None] + np.arange(2) for _, starts, _ in parts]  # (S, 2)
    streams = {
        name: np.concatenate([part[0].observations[name][index] for part, index in zip(parts, pairs, strict=True)])
        for name in ("grid", "carried")
    }
    names = np.concatenate([[codec.content_id(episode.observations)] * len(starts) for episode, starts, _ in parts])
    return {
        **streams,
        "sets": np.concatenate([sets for *_, sets in parts]),
        "trajectory": names.astype("U64"),
        "start": np.concatenate([np.asarray(starts, np.int64) for _, starts, _ in parts]),
    }


def _packed_states(
    parts: Sequence[tuple[Episode, Sequence[int], NDArray[np.bool_]]],
) -> dict[str, NDArray[np.generic]]:
    names = parts[0][0].states
    return {
        STATE + name: np.concatenate([part.states[name][list(starts)] for part, starts, _ in parts]) for name in names
    }


def _batch(arrays: dict[str, NDArray[np.generic]]) -> SegmentBatch:
    sets = torch.from_numpy(arrays["sets"]).unsqueeze(1)  # (N, 7) -> (N, 1, 7)
    names = zip(arrays["trajectory"].tolist(), arrays["start"].tolist(), strict=True)
    return SegmentBatch(
        {name: torch.from_numpy(arrays[name]) for name in ("grid", "carried")},
        sets.byte().argmax(-1),
        sets,
        tuple(Segment(str(trajectory), int(start)) for trajectory, start in names),
    )
