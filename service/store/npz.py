"""The exchange format: npz with one array a stream. Never unpickled."""

import io
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ForeignFile

METADATA = "__metadata__"


def dump(arrays: Mapping[str, NDArray[Any]], metadata: str | None = None) -> bytes:
    """Arrays to npz bytes; `metadata` goes in as a 0-d unicode array."""
    buffer = io.BytesIO()
    named: dict[str, Any] = dict(arrays) | ({} if metadata is None else {METADATA: np.array(metadata)})
    np.savez(buffer, **named)
    return buffer.getvalue()


def parse(data: bytes, source: str, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Npz bytes to arrays. Raises ForeignFile for anything that is not a whole npz of plain arrays."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(info.file_size for info in archive.infolist())
        if size > max_bytes:
            raise ForeignFile(source, f"unpacks to {size} bytes, {max_bytes} are allowed")
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files if name != METADATA}
    except (zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, KeyError) as error:
        raise ForeignFile(source, f"is not a whole npz file of plain arrays ({error})") from error
