"""The exchange format: npz with one array a stream. Never unpickled."""

import io
import math
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ForeignFile

npy: Any = np.lib.format  # it has no types
METADATA = "__metadata__"
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # what numpy writes; zipfile bounds the output of no other


def dump(arrays: Mapping[str, NDArray[Any]], metadata: str | None = None) -> bytes:
    """Arrays to npz bytes; `metadata` goes in as a 0-d unicode array."""
    named = dict(arrays) | ({} if metadata is None else {METADATA: np.array(metadata)})
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:  # np.savez takes names as keywords: no stream could be named "file"
        for name, array in named.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                npy.write_array(member, array, allow_pickle=False)
    return buffer.getvalue()


def parse(data: bytes, source: str, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Npz bytes to arrays, read-only. Raises ForeignFile for anything that is not a whole npz of plain arrays."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            _check_size(archive, source, max_bytes)
            named = {info.filename.removesuffix(".npy"): _array(archive, info) for info in archive.infolist()}
    except ForeignFile:
        raise
    except Exception as error:  # on bytes that are not theirs the parsers of zip and npy raise a dozen kinds of errors
        raise ForeignFile(source, f"is not a whole npz file of plain arrays ({error})") from error
    return {name: array for name, array in named.items() if name != METADATA}


def _check_size(archive: zipfile.ZipFile, source: str, max_bytes: int) -> None:
    size = sum(info.file_size for info in archive.infolist())
    if size > max_bytes:
        raise ForeignFile(source, f"unpacks to {size} bytes, {max_bytes} are allowed")


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """One member. Its size is checked before numpy believes what the header promises. Raises ValueError."""
    if info.compress_type not in COMPRESSIONS:
        raise ValueError(f"{info.filename} has compression {info.compress_type}")
    with archive.open(info) as member:
        content = member.read(info.file_size)  # bounded: a plain read() unpacks all that a lying member holds
    stream = io.BytesIO(content)
    version = npy.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"{info.filename} has npy version {version}")
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran, dtype = read_header(stream)
    promised, held = math.prod(shape) * dtype.itemsize, len(content) - stream.tell()
    if dtype.hasobject or promised != held:
        raise ValueError(f"{info.filename} promises {promised} bytes of {dtype} and holds {held}")
    return np.ndarray(shape, dtype, content, stream.tell(), order="F" if fortran else "C")
