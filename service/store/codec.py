"""The trajectory object: a safetensors container of named arrays, time first, image-like streams in zstd frames.

Metadata (JSON in the safetensors header): format, version, and for each stream dtype, shape without time, codec and
the steps of a chunk. A raw stream is one tensor `name`; a zstd stream is the uint8 tensors `name/0`, `name/1`, ...
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from service.store.errors import ForeignFile

FORMAT = "asim-trajectory"
VERSION = 1
CHUNK_STEPS = 20
ZSTD_LEVEL = 3
Arrays = dict[str, NDArray[Any]]


def content_id(arrays: Mapping[str, NDArray[Any]]) -> str:
    """sha256 of the decoded arrays: name, dtype, shape and bytes of each, by name. No encoder's version enters it."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(json.dumps([name, array.dtype.str, array.shape]).encode())
        digest.update(array.data)
    return digest.hexdigest()


def encode(arrays: Mapping[str, NDArray[Any]], extra: Mapping[str, object] | None = None) -> bytes:
    """Arrays (T + 1, ...) to bytes; `extra` is JSON that `decode` gives back."""
    tensors: Arrays = {}
    streams = {}
    for name, array in arrays.items():
        image_like = array.ndim >= 3
        tensors |= _compressed(name, array) if image_like else {name: np.ascontiguousarray(array)}
        streams[name] = {"dtype": array.dtype.name, "shape": array.shape[1:], "codec": "zstd" if image_like else "raw"}
    steps = len(next(iter(arrays.values())))
    header = {"format": FORMAT, "version": VERSION, "steps": steps, "chunk": CHUNK_STEPS, "streams": streams}
    return save(tensors, {"asim": json.dumps(header | {"extra": dict(extra or {})})})


def decode(data: bytes, source: str, start: int = 0, stop: int | None = None) -> tuple[Arrays, dict[str, Any]]:
    """Observations `start` to `stop` (exclusive) of every stream, and the extra JSON. Raises ForeignFile."""
    header = _header(data, source)
    try:
        tensors = load(data)
        stop = header["steps"] if stop is None else stop
        arrays = {name: _stream(tensors, name, header, start, stop) for name in header["streams"]}
    except (SafetensorError, zstandard.ZstdError, KeyError, ValueError) as error:
        raise ForeignFile(source, f"is truncated or damaged ({error})") from error
    return arrays, header["extra"]


def _compressed(name: str, array: NDArray[Any]) -> Arrays:
    compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
    chunks = [array[i : i + CHUNK_STEPS] for i in range(0, len(array), CHUNK_STEPS)]
    frames = [compressor.compress(np.ascontiguousarray(chunk).data) for chunk in chunks]
    return {f"{name}/{i}": np.frombuffer(frame, np.uint8) for i, frame in enumerate(frames)}


def _stream(tensors: Arrays, name: str, header: dict[str, Any], start: int, stop: int) -> NDArray[Any]:
    spec = header["streams"][name]
    if spec["codec"] == "raw":
        return tensors[name][start:stop]
    chunk = header["chunk"]
    first, last = start // chunk, (stop - 1) // chunk
    decompressor = zstandard.ZstdDecompressor()
    data = b"".join(decompressor.decompress(tensors[f"{name}/{i}"].tobytes()) for i in range(first, last + 1))
    array = np.frombuffer(data, spec["dtype"]).reshape(-1, *spec["shape"])
    return array[start - first * chunk : stop - first * chunk]


def _header(data: bytes, source: str) -> dict[str, Any]:
    """The container's own metadata; the safetensors header is JSON behind an 8-byte length."""
    try:
        length = int.from_bytes(data[:8], "little")
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["asim"])
    except (ValueError, KeyError, TypeError) as error:
        raise ForeignFile(source, "is not an ASIM trajectory object") from error
    if not isinstance(header, dict) or (header.get("format"), header.get("version")) != (FORMAT, VERSION):
        raise ForeignFile(source, f"says that it is {str(header)[:80]}, not {FORMAT} version {VERSION}")
    return header
