"""Recorded trajectories with their actions, from npz files."""

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from uuid import UUID

import numpy as np

from api_schemas.labels import LabeledTrajectory, LabelsAccepted, LabelSource, LabelsRequest
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
    """Post the files as labeled trajectories, a batch after the other; how many it held, and what became of it."""
    read = (_labeled_trajectory(path, split) for path in paths)
    source = LabelSource(kind="import", name="asim import")
    for batch in batches(read, lambda one: len(one.content), BATCH_FILES, BATCH_BYTES):
        accepted = client.label(LabelsRequest(project=project, source=source, trajectories=batch))
        yield len(batch), accepted


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
