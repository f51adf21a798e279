"""Uploads that must be refused, drawn by a seed: eight kinds of them, each with words for its fault."""

import base64
import io
import json
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.service.kit import Arrays, npz, robot, room

BOMB_BYTES = 300 * 2**20  # over the 256 MiB that a request may unpack to
LARGE_BYTES = 240 * 2**20  # under them
SIZE_OFFSET, CHECKSUM_OFFSET = 24, 16  # of the unpacked size, and of its checksum, in an entry of a zip's directory
DTYPES = ("int8", "uint16", "int64", "float16", "float32", "complex64", ">u2", "U3", "S1", "datetime64[s]", "O")
PATHS = ("../grid", "../../../../etc/passwd", "/grid", "..\\grid", "a/b/grid", "C:grid", "grid/", "~/grid")
NPY: Any = np.lib.format  # it has no types
ENTRY = b"PK\x01\x02"


@dataclass(frozen=True)
class Malformed:
    """kind: of fault. body: an npz, or JSON where `path` is given. words: one of them is in the refusal."""

    kind: str
    body: bytes
    words: tuple[str, ...]
    of_robot: bool = False
    path: str | None = None


Draw = Callable[[np.random.Generator], Malformed]


def malformed(seed: int, count: int) -> Iterator[Malformed]:
    """As many of each kind."""
    rng = np.random.default_rng(seed)
    kinds: tuple[Draw, ...] = (
        truncated,
        bit_flipped,
        wrong_dtype,
        not_finite,
        huge_header,
        zip_bomb,
        path_in_a_name,
        nested_json,
    )
    for number in range(count):
        yield kinds[number % len(kinds)](rng)


def truncated(rng: np.random.Generator) -> Malformed:
    """Some of a whole file."""
    whole = npz(room(int(rng.integers(1000)), transitions=int(rng.integers(1, 40))))
    return Malformed("truncated", whole[: int(rng.integers(len(whole)))], ("whole npz",))


def bit_flipped(rng: np.random.Generator) -> Malformed:
    """One to three bits of an array's data."""
    whole = bytearray(npz(room(int(rng.integers(1000)), transitions=20)))
    with zipfile.ZipFile(io.BytesIO(bytes(whole))) as archive:
        info = archive.infolist()[int(rng.integers(2))]
    name, extra = struct.unpack_from("<HH", whole, info.header_offset + 26)
    first = info.header_offset + 30 + name + extra
    for place in rng.choice(info.compress_size, int(rng.integers(1, 4)), replace=False):
        whole[first + int(place)] ^= 1 << int(rng.integers(8))
    return Malformed("bit flipped", bytes(whole), ("whole npz", "streams", "dtype", "shape"))


def wrong_dtype(rng: np.random.Generator) -> Malformed:
    """Numbers, texts and objects in place of bytes."""
    dtype = rng.choice(DTYPES)
    arrays: dict[str, NDArray[Any]] = dict(room(int(rng.integers(1000))))
    arrays["grid"] = arrays["grid"].astype("u8").astype(dtype)
    return Malformed("wrong dtype", npz(arrays), ("dtype", "promises"))  # of objects the pickle is not even read


def not_finite(rng: np.random.Generator) -> Malformed:
    """NaN or an infinity somewhere in a robot's proprioception."""
    arrays = robot(int(rng.integers(1000)))
    place = tuple(int(rng.integers(size)) for size in arrays["proprioception"].shape)
    arrays["proprioception"][place] = rng.choice([np.nan, np.inf, -np.inf])
    return Malformed("not finite", npz(arrays), (f"proprioception{list(place)}",), of_robot=True)


def huge_header(rng: np.random.Generator) -> Malformed:
    """A header that says it is gigabytes long, is long, or promises an array that no machine holds."""
    shape = f"({int(rng.integers(2**30, 2**40))}, 6, 6, 3)"
    told = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}".encode()
    length = int(rng.choice([len(told), 2**32 - 1, 60_000]))
    padded = told.ljust(60_000) if length == 60_000 else told
    member = b"\x93NUMPY\x02\x00" + struct.pack("<I", length) + padded + b"\0" * 100
    return Malformed("huge header", _zipped({"grid": member}), ("header of", "promises"))


def zip_bomb(rng: np.random.Generator) -> Malformed:
    """Zeros that unpack to more than is allowed, to little less and of no use or damaged, or to more than they say."""
    return (_too_large, _large_and_foreign, _lying, _damaged)[int(rng.integers(4))](rng)


def path_in_a_name(rng: np.random.Generator) -> Malformed:
    """Members that would be files elsewhere, if anybody unpacked them to files."""
    name = str(rng.choice(PATHS))
    arrays = room(int(rng.integers(1000)))
    members = {name: _npy(arrays["grid"]), "carried": _npy(arrays["carried"])}
    return Malformed("path in a name", _zipped(members), ("streams", "whole npz"))


def nested_json(rng: np.random.Generator) -> Malformed:
    """Deep or wide: few bytes of which a parser, or who names each fault, makes much."""
    return (deep_json if rng.random() < 0.5 else wide_json)(rng)


def wide_json(rng: np.random.Generator) -> Malformed:
    """Many fields that nobody knows, many wrong values in one list, many lists of nothing."""
    many = int(10 ** rng.uniform(3, 5.5))
    path = str(rng.choice(["/labels", "/acquire", "/projects"]))
    fields = {f"field{number}": 0 for number in range(many)}
    content = base64.b64encode(npz(room(0))).decode()
    bodies = (
        fields,
        {"project": "PROJECT", "count": 1, "items": [fields]},
        {"project": "PROJECT", "trajectories": [{"content": content, "actions": ["x"] * many}]},
        {"name": "n", "environment": {"spaces": {"observations": {"a": {"dtype": "uint8", "high": [""] * many}}}}},
        {"project": "PROJECT", "items": [[]] * many},
    )
    words = ("fields", "should", "required", "permitted", "number", "content-length", "body", "many", "at most")
    return Malformed("nested JSON", json.dumps(bodies[int(rng.integers(len(bodies)))]).encode(), words, path=path)


def deep_json(rng: np.random.Generator) -> Malformed:
    """Nothing, many times nested: closed or not, alone or as a field."""
    depth, opening, closing = int(10 ** rng.uniform(2.5, 6)), *[(b"[", b"]"), (b'{"a":', b"}")][int(rng.integers(2))]
    inner = opening * depth + (b"1" + closing * depth if rng.random() < 0.5 else b"")
    field = b'{"project": "PROJECT", "items": ' + inner + b"}"
    path = str(rng.choice(["/labels", "/acquire", "/projects"]))
    words = ("body", "JSON", "items", "Field required", "content-length")
    return Malformed("nested JSON", field if rng.random() < 0.5 else inner, words, path=path)


def _too_large(rng: np.random.Generator) -> Malformed:
    return Malformed("zip bomb", _zeros(BOMB_BYTES), ("unpacks to",))


def _large_and_foreign(rng: np.random.Generator) -> Malformed:
    return Malformed("zip bomb", _zeros(LARGE_BYTES), ("streams", "dtype", "shape"), of_robot=bool(rng.integers(2)))


def _lying(rng: np.random.Generator) -> Malformed:
    """The directory tells a small size, and so does the header of the array."""
    whole = bytearray(_zeros(BOMB_BYTES))
    struct.pack_into("<I", whole, whole.rindex(ENTRY) + SIZE_OFFSET, 10 + int(rng.integers(10_000)))
    return Malformed("zip bomb", bytes(whole), ("whole npz",))


def _damaged(rng: np.random.Generator) -> Malformed:
    """All that a project asks for, up to a checksum that is seen once everything is unpacked."""
    whole = bytearray(large_room())
    struct.pack_into("<I", whole, whole.rindex(ENTRY) + CHECKSUM_OFFSET, int(rng.integers(2**32)))
    return Malformed("zip bomb", bytes(whole), ("whole npz",))


@cache
def large_room() -> bytes:
    """A whole file of a room that stands still for long; as large as a request may be, but for a little."""
    steps = LARGE_BYTES // (6 * 6 * 3)
    grid, carried = np.zeros((steps, 6, 6, 3), np.uint8), np.zeros((steps, 3), np.uint8)
    return _zipped({"carried": _npy(carried), "grid": _npy(grid)})


@cache
def _zeros(size: int) -> bytes:
    """A file of one member that a project may have, as large as that."""
    step = 10 * 10 * 3  # no project here has rooms of 10
    return _zipped({"grid": _npy(np.zeros((size // step, 10, 10, 3), np.uint8))})


def _zipped(members: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def _npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    NPY.write_array(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def valid(seed: int) -> tuple[Arrays, Arrays]:
    """A room and a robot that are taken: who refuses everything is not tested by refusals."""
    return room(seed), robot(seed)
