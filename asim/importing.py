"""Recorded trajectories with their actions, from npz files."""

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from uuid import UUID

import numpy as np

from api_schemas.labels import MOST_SEGMENTS, LabeledTrajectory, LabelsAccepted, LabelSource, LabelsRequest
from api_schemas.projects import Project
from api_schemas.trajectories import SplitChoice
from asim.arrays import pack, unpack
from asim.batches import batches
from asim.client import Client
from asim.errors import AsimError

BATCH_FILES, BATCH_BYTES = 200, 24 * 2**20  # of one request; in base64, with actions, well below the service's limit
ACTIONS = "actions.npy"  # the member of an npz file that holds an array named actions


def has_actions(path: Path) -> bool:
    """Whether the npz file holds an array `actions`. Raises AsimError where it is no npz file."""
    try:
        with zipfile.ZipFile(path) as archive:
            return ACTIONS in archive.namelist()
    except zipfile.BadZipFile as error:
        raise AsimError(f"{path}: not an npz file ({error})") from error


def add_labeled(
    client: Client, project: UUID, paths: Sequence[Path], split: SplitChoice
) -> Iterator[tuple[int, LabelsAccepted]]:
    """Post the files as labeled trajectories, a batch after the other; how many it held, and what became of it.

    A file with more segments than one request may bring is sent in parts, which count each.
    """
    known, source = client.project(project), LabelSource(kind="import", name="asim import")
    read = (piece for path in paths for piece in _pieces(_labeled_trajectory(path, split), known))
    for batch in batches(read, lambda one: _size(one, known), BATCH_FILES, BATCH_BYTES):
        accepted = client.label(LabelsRequest(project=project, source=source, trajectories=batch))
        yield len(batch), accepted


def _pieces(one: LabeledTrajectory, project: Project) -> Iterator[LabeledTrajectory]:
    starts = _starts(one, project)
    if len(starts) <= MOST_SEGMENTS:
        yield one
        return
    for first in range(0, len(starts), MOST_SEGMENTS):
        yield one.model_copy(update={"starts": list(starts[first : first + MOST_SEGMENTS])})


def _starts(one: LabeledTrajectory, project: Project) -> Sequence[int]:
    """Of the segments that it brings."""
    return range(0, len(one.actions) - project.segment_length + 1, project.stride) if one.starts is None else one.starts


def _size(one: LabeledTrajectory, project: Project) -> int:
    """Bytes, or as many as its segments take up of what one request may bring."""
    return max(len(one.content), len(_starts(one, project)) * BATCH_BYTES // MOST_SEGMENTS)


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
