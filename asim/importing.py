"""Recorded trajectories, with or without their actions, from npz files.

A request is taken whole or not at all. Three are on their way at once: the service receives one while it stores the
others.
"""

import zipfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from itertools import takewhile
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar
from uuid import UUID

import numpy as np

from api_schemas.labels import MOST_SEGMENTS, LabeledTrajectory, LabelsAccepted, LabelSource, LabelsRequest
from api_schemas.projects import Project
from api_schemas.trajectories import SplitChoice, TrajectoriesAdded, TrajectoryReceipt
from asim.arrays import pack, unpack
from asim.batches import batches
from asim.client import Client
from asim.errors import AsimError, Conflict, Invalid

UPLOAD_FILES, UPLOAD_BYTES = 200, 32 * 2**20  # of one request, so that no upload meets the service's limit
BATCH_FILES, BATCH_BYTES = 200, 24 * 2**20  # of one with actions: in base64 well below the service's limit
AHEAD = 3  # requests on their way at once
ACTIONS = "actions.npy"  # the member of an npz file that holds an array named actions
Answer = TypeVar("Answer")


class ImportStopped(AsimError):
    """A file cannot be read, or the service refuses it; the text names it and says how many are in."""


class Piece(NamedTuple):
    """Of a file: what one request brings. `labeled` is None where the file goes as it is."""

    path: Path
    labeled: LabeledTrajectory | None = None


def has_actions(path: Path) -> bool:
    """Whether the npz file holds an array `actions`. Raises AsimError where it is no npz file."""
    try:
        with zipfile.ZipFile(path) as archive:
            return ACTIONS in archive.namelist()
    except zipfile.BadZipFile as error:
        raise AsimError(f"{path}: not an npz file ({error})") from error


def add_plain(client: Client, project: UUID, paths: Sequence[Path], split: SplitChoice) -> Iterator[TrajectoryReceipt]:
    """Upload the files as trajectories: a receipt each, in order. Raises ImportStopped."""

    def send(batch: Sequence[Piece]) -> TrajectoriesAdded:
        with ExitStack() as stack:
            files = {str(piece.path): stack.enter_context(piece.path.open("rb")) for piece in batch}
            return client.add_files(project, files, split)

    sending = _Sending(send, len(paths))
    cut = batches(map(Piece, paths), lambda piece: piece.path.stat().st_size, UPLOAD_FILES, UPLOAD_BYTES)
    for _, added in sending.answers(cut):
        yield from added.items


def add_labeled(
    client: Client, project: UUID, paths: Sequence[Path], split: SplitChoice
) -> Iterator[tuple[Sequence[Path], LabelsAccepted]]:
    """Post the files as labeled trajectories: those of each request, and what became of them. Raises ImportStopped.

    A file with more segments than one request may bring is sent in parts, and named with each.
    """
    known, source = client.project(project), LabelSource(kind="import", name="asim import")

    def send(batch: Sequence[Piece]) -> LabelsAccepted:
        brought = [piece.labeled for piece in batch if piece.labeled is not None]
        return client.label(LabelsRequest(project=project, source=source, trajectories=brought))

    sending = _Sending(send, len(paths))
    read = (Piece(path, part) for path in paths for part in _parts(_labeled_trajectory(path, split), known))
    cut = batches(sending.readable(read), lambda piece: _size(piece, known), BATCH_FILES, BATCH_BYTES)
    for batch, accepted in sending.answers(cut):
        yield [piece.path for piece in batch], accepted


class _Sending(Generic[Answer]):
    """Batches on their way to the service, AHEAD at once; `send` posts one."""

    def __init__(self, send: Callable[[Sequence[Piece]], Answer], files: int) -> None:
        self._send, self._files = send, files
        self._taken = set[Path]()
        self._refused: AsimError | None = None
        self._unreadable: AsimError | None = None

    def answers(self, cut: Iterable[Sequence[Piece]]) -> Iterator[tuple[Sequence[Piece], Answer]]:
        """Each batch with its answer, in order. After a refused one no other is sent; ImportStopped is raised once
        those on their way are answered too."""
        with ThreadPoolExecutor(AHEAD) as threads:
            waiting = deque[tuple[Sequence[Piece], Future[Answer]]]()
            for batch in takewhile(lambda _: self._refused is None, cut):
                waiting.append((batch, threads.submit(self._send, batch)))
                if len(waiting) == AHEAD:
                    yield from self._answer(*waiting.popleft())
            for batch, sent in waiting:
                yield from self._answer(batch, sent)
        fault = self._refused or self._unreadable
        if fault is not None:
            raise ImportStopped(f"{fault}; {len(self._taken)} of {self._files} files are in") from fault

    def readable(self, pieces: Iterable[Piece]) -> Iterator[Piece]:
        """Those before the first file that cannot be read."""
        try:
            yield from pieces
        except AsimError as error:
            self._unreadable = error

    def _answer(self, batch: Sequence[Piece], sent: "Future[Answer]") -> Iterator[tuple[Sequence[Piece], Answer]]:
        try:
            answer = sent.result()
        except (Invalid, Conflict):
            yield from self._one_by_one(batch)
        except AsimError as error:
            self._refused = self._refused or error
        else:
            yield self._accepted(batch, answer)

    def _one_by_one(self, batch: Sequence[Piece]) -> Iterator[tuple[Sequence[Piece], Answer]]:
        """Up to the one at fault: the service names what was refused by its place in the request, or by its content."""
        for piece in batch if self._refused is None else ():
            try:
                answer = self._send([piece])
            except AsimError as error:
                self._refused = _naming(piece.path, error)
                return
            yield self._accepted([piece], answer)

    def _accepted(self, batch: Sequence[Piece], answer: Answer) -> tuple[Sequence[Piece], Answer]:
        self._taken |= {piece.path for piece in batch}
        return batch, answer


def _naming(path: Path, error: AsimError) -> AsimError:
    return error if str(path) in str(error) else AsimError(f"{path}: {error}")


def _parts(one: LabeledTrajectory, project: Project) -> Iterator[LabeledTrajectory]:
    starts = _starts(one, project)
    if len(starts) <= MOST_SEGMENTS:
        yield one
        return
    for first in range(0, len(starts), MOST_SEGMENTS):
        yield one.model_copy(update={"starts": list(starts[first : first + MOST_SEGMENTS])})


def _starts(one: LabeledTrajectory, project: Project) -> Sequence[int]:
    """Of the segments that it brings."""
    return range(0, len(one.actions) - project.segment_length + 1, project.stride) if one.starts is None else one.starts


def _size(piece: Piece, project: Project) -> int:
    """Bytes, or as many as its segments take up of what one request may bring."""
    one = piece.labeled
    return 0 if one is None else max(len(one.content), len(_starts(one, project)) * BATCH_BYTES // MOST_SEGMENTS)


def _labeled_trajectory(path: Path, split: SplitChoice) -> LabeledTrajectory:
    try:
        arrays = unpack(path.read_bytes())
    except ValueError as error:
        raise AsimError(f"{path}: {error}") from error
    actions = arrays.pop("actions")
    if not np.issubdtype(actions.dtype, np.integer) and not np.issubdtype(actions.dtype, np.floating):
        raise AsimError(f"{path}: actions have dtype {actions.dtype}, not integers or floats")
    # Base64Bytes is given encoded bytes and holds decoded ones: constructing skips that round trip.
    return LabeledTrajectory.model_construct(content=pack(arrays), actions=actions.tolist(), split=split)
