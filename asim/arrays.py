"""Named arrays as npz bytes, which is how observations travel over HTTP."""

import io
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[np.generic]]


def pack(arrays: Mapping[str, NDArray[np.generic]]) -> bytes:
    """An uncompressed npz file of `arrays`, one member a name; observations have T + 1 rows, time first."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def unpack(content: bytes) -> Arrays:
    """The arrays of an npz file. Raises ValueError where it holds pickled objects."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}
