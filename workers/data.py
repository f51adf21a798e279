"""From rows and blobs to segment batches. Observations and labels only: nothing here can open a simulator state."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from api_schemas.environments import Actions, DiscreteActions, Spaces
from models.families import BoxAction, DiscreteAction, StreamSpec
from models.families import Spaces as ModelSpaces
from models.segments import Segment, SegmentBatch, concatenate
from service import projects
from service.store import codec
from service.store.blobs import Blobs
from service.store.database import Database
from service.store.queries import labels as label_queries
from service.store.queries import pool as pool_queries
from service.store.tables import LabelRow, MembershipRow, ProjectRow

AfterEach = Callable[[], None]  # called after each trajectory is read; may raise to stop
CHUNK_SEGMENTS, CHUNK_BYTES = 2048, 2**28  # decoded at a time: bounds memory whatever the size of the pool


@dataclass(frozen=True)
class Windows:
    """Segments to cut from one stored trajectory."""

    trajectory: str
    blob_sha256: str
    starts: tuple[int, ...]


def model_spaces(spaces: Spaces) -> ModelSpaces:
    """The project's spaces as models take them."""
    streams = {name: StreamSpec(stream.shape, stream.dtype) for name, stream in spaces.observations.items()}
    action = spaces.actions
    if isinstance(action, DiscreteActions):
        return ModelSpaces(streams, DiscreteAction(action.n))
    return ModelSpaces(streams, BoxAction(action.low, action.high, action.shape, action.signs))


def groups(actions: Actions) -> Mapping[str, Sequence[int]]:
    """Groups of actions for which model error is reported apart; of a box there are none."""
    return actions.groups if isinstance(actions, DiscreteActions) else {}


def fitting(project: ProjectRow, count: int, most: int) -> int:
    """How many of `count` segments have observations that fit into `most` bytes as arrays, at least 1."""
    streams = projects.spaces_of(project).observations.values()
    observation = sum(math.prod(stream.shape) * np.dtype(stream.dtype).itemsize for stream in streams)
    return max(1, min(count, most // (observation * (project.segment_length + 1))))


def thinned(project: ProjectRow, windows: Sequence[Windows], count: int, most: int) -> list[Windows]:
    """Evenly as many of all segments as are no more than `count` and fit into `most` bytes, of each trajectory some."""
    total = sum(len(window.starts) for window in windows)
    every = -(-total // fitting(project, max(1, count), most))
    return [replace(window, starts=window.starts[::every]) for window in windows if window.starts]


def windows_of(
    session: Session, project: ProjectRow, members: Sequence[MembershipRow], starts: Mapping[str, Sequence[int]] | None
) -> list[Windows]:
    """The given segments of these members, or all of theirs, in the members' order."""
    contents = pool_queries.contents(session, [member.trajectory_id for member in members])
    windows = []
    for member in members:
        every = range(0, member.segments * project.stride, project.stride)
        chosen = tuple(every if starts is None else starts[member.trajectory_id])
        windows.append(Windows(member.trajectory_id, contents[member.trajectory_id].blob_sha256, chosen))
    return windows


def load(blobs: Blobs, windows: Sequence[Windows], length: int, after_each: AfterEach = lambda: None) -> SegmentBatch:
    """All windows as one batch of segments of `length` transitions, in order."""
    parts: dict[str, list[NDArray[Any]]] = {}
    segments: list[Segment] = []
    for window in windows:
        data = blobs.get("trajectories", window.blob_sha256)
        arrays, _ = codec.decode(data, f"trajectory {window.trajectory}")
        index = np.asarray(window.starts)[:, None] + np.arange(length + 1)  # (S, L+1)
        for name, array in arrays.items():
            parts.setdefault(name, []).append(array[index])  # (T+1, ...) -> (S, L+1, ...)
        segments.extend(Segment(window.trajectory, start) for start in window.starts)
        after_each()
    observations = {name: torch.from_numpy(np.concatenate(arrays)) for name, arrays in parts.items()}
    return SegmentBatch(observations, segments=tuple(segments))


def chunks(
    blobs: Blobs, project: ProjectRow, windows: Sequence[Windows], after_each: AfterEach = lambda: None
) -> Iterator[SegmentBatch]:
    """The same segments in batches of about CHUNK_SEGMENTS or CHUNK_BYTES, whole trajectories each, one read ahead.

    Reading waits for disk or network most of the time, so the next batch is read while this one is scored.
    """
    length = project.segment_length
    parts = _parts(windows, fitting(project, CHUNK_SEGMENTS, CHUNK_BYTES))
    with ThreadPoolExecutor(1, "read-ahead") as reader:
        ahead = None
        for part in parts:
            ready, ahead = ahead, reader.submit(load, blobs, part, length, after_each)
            if ready is not None:
                yield ready.result()
        if ahead is not None:
            yield ahead.result()


def _parts(windows: Sequence[Windows], most: int) -> Iterator[list[Windows]]:
    part: list[Windows] = []
    segments = 0
    for window in windows:
        if not window.starts:
            continue
        part.append(window)
        segments += len(window.starts)
        if segments >= most:
            yield part
            part, segments = [], 0
    if part:
        yield part


def labeled_batch(
    database: Database,
    blobs: Blobs,
    project: ProjectRow,
    split: str,
    watermark: int,
    after_each: AfterEach = lambda: None,
) -> SegmentBatch | None:
    """All labeled segments of a split up to a watermark, in the order of acceptance; None where there are none."""
    with database.read() as session:  # ended before the first blob is read: a database ends those that sit idle
        rows = label_queries.labels_up_to(session, project.id, split, watermark)
        contents = pool_queries.contents(session, sorted({row.trajectory_id for row in rows}))
    if not rows:
        return None
    windows = [Windows(row.trajectory_id, contents[row.trajectory_id].blob_sha256, (row.start,)) for row in rows]
    batch = load_in_order(blobs, windows, project.segment_length, after_each)
    action = projects.spaces_of(project).actions
    if not isinstance(action, DiscreteActions):
        actions = torch.tensor([row.actions for row in rows], dtype=torch.float32)  # (B, L, D)
        return SegmentBatch(batch.observations, actions, segments=batch.segments)
    actions = torch.tensor([row.actions for row in rows], dtype=torch.int64)  # (B, L)
    return SegmentBatch(batch.observations, actions, _sets(rows, action.n), batch.segments)


def load_in_order(
    blobs: Blobs, windows: Sequence[Windows], length: int, after_each: AfterEach = lambda: None
) -> SegmentBatch:
    """Each trajectory is opened once, and the segments come back in the order in which they were asked for."""
    places: dict[str, list[int]] = {}
    for place, window in enumerate(windows):
        places.setdefault(window.trajectory, []).append(place)
    grouped = [
        Windows(name, windows[of[0]].blob_sha256, tuple(windows[place].starts[0] for place in of))
        for name, of in places.items()
    ]
    batch = concatenate([load(blobs, [window], length, after_each) for window in grouped])
    order = [place for of in places.values() for place in of]
    return batch.take(torch.from_numpy(np.argsort(order)))


def _sets(rows: Sequence[LabelRow], n: int) -> torch.Tensor:
    """(B, L, n) bool: the stored set of a step, or its action alone."""
    sets = torch.zeros(len(rows), len(rows[0].actions), n, dtype=torch.bool)
    for i, row in enumerate(rows):
        choices: Any = row.action_sets or [[action] for action in row.actions]
        for step, actions in enumerate(choices):
            sets[i, step, actions] = True
    return sets
