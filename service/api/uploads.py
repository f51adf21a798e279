"""Files of a multipart form, left where they came to lie.

A body is held in memory, or in a file without a name where it is long or does not say how long it is; each file of the
form is a view of it. FastAPI's own forms copy each file twice, and write all that are longer than 1 MiB to disk, every
piece by another trip to a thread.
"""

import mmap
import tempfile
from contextlib import closing
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from fastapi import HTTPException, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from python_multipart import MultipartParser
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import parse_options_header

from service.errors import InvalidField

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

FIELD = "files"
MOST_FILES = 1000
IN_MEMORY = 40 * 2**20  # bytes of a body: what `asim import` sends at once, and a little
PIECE = 2**20  # bytes that go to the disk at once
KIND = "multipart/form-data"
NPZ_FILES = {
    "description": "npz files, one a trajectory",
    "type": "array",
    "items": {"type": "string", "contentMediaType": "application/octet-stream"},
    "minItems": 1,
    "maxItems": MOST_FILES,
}
FORM: dict[str, Any] = {"type": "object", "properties": {FIELD: NPZ_FILES}, "required": [FIELD]}
DESCRIBED = {"requestBody": {"required": True, "content": {KIND: {"schema": FORM}}}}  # a route's `openapi_extra`


class Upload(NamedTuple):
    """A file as it was sent; its name says nothing but which one is meant."""

    name: str
    content: memoryview


async def uploads(request: Request) -> list[Upload]:
    """The files of a request's form. Raises RequestValidationError, InvalidField and HTTPException."""
    kind, options = parse_options_header(request.headers.get("content-type"))
    if kind != KIND.encode():
        raise _missing()
    with closing(_place(request)) as place:
        try:
            form = _Form(options.get(b"boundary", b""), place)
            async for piece in request.stream():
                form.write(piece)
                await place.settle(PIECE)
            form.finalize()
        except FormParserError as error:
            raise HTTPException(HTTPStatus.BAD_REQUEST, f"body: is no whole {KIND} ({error})") from error
        await place.settle(1)
        if not form.found:
            raise _missing()
        held = place.held()
    return [Upload(name, held[first:last]) for name, first, last in form.found]


class _Place(Protocol):
    """Where the files of a body go, one behind the other. size: bytes so far."""

    size: int

    def add(self, piece: memoryview) -> None:
        """Behind what is there."""

    async def settle(self, least: int) -> None:
        """Write what waits, where it is as many bytes."""

    def held(self) -> memoryview:
        """All that was added and settled."""

    def close(self) -> None:
        """Views that were given out stay."""


def _place(request: Request) -> _Place:
    length = request.headers.get("content-length", "")
    told = "transfer-encoding" not in request.headers and length.isdigit()
    return _Memory(int(length)) if told and int(length) <= IN_MEMORY else _Disk()


class _Memory:
    """Of a body that says its length; memory that nobody wrote to yet is none."""

    def __init__(self, length: int) -> None:
        self._room, self.size = np.empty(length, np.uint8).data, 0

    def add(self, piece: memoryview) -> None:
        end = self.size + len(piece)
        if end > len(self._room):
            told = f"body: is longer than the {len(self._room)} bytes that content-length tells"
            raise HTTPException(HTTPStatus.BAD_REQUEST, told)
        self._room[self.size : end] = piece
        self.size = end

    async def settle(self, least: int) -> None:
        """Nothing waits."""

    def held(self) -> memoryview:
        return self._room[: self.size]

    def close(self) -> None:
        """The form holds this, and is part of a cycle: the memory would wait until somebody looks for those."""
        self._room = memoryview(b"")


class _Disk:
    """A file that is gone once nobody has a view of it."""

    def __init__(self) -> None:
        self._file, self._waiting, self.size = tempfile.TemporaryFile(buffering=0), bytearray(), 0  # noqa: SIM115

    def add(self, piece: memoryview) -> None:
        self._waiting += piece
        self.size += len(piece)

    async def settle(self, least: int) -> None:
        if len(self._waiting) >= least:
            waiting, self._waiting = self._waiting, bytearray()
            await run_in_threadpool(self._write, waiting)

    def held(self) -> memoryview:
        return memoryview(mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ) if self.size else b"")

    def close(self) -> None:
        self._file.close()

    def _write(self, content: bytearray) -> None:
        left = memoryview(content)
        while left:
            left = left[self._file.write(left) :]


class _Form(MultipartParser):
    """found: name, first byte and end of each part of the field FIELD, in the place that it is written to."""

    def __init__(self, boundary: bytes, place: _Place) -> None:
        if not boundary:
            raise FormParserError("content-type names no boundary")
        heard: MultipartCallbacks = {
            "on_part_begin": self._begin,
            "on_header_field": self._name_header,
            "on_header_value": self._value_header,
            "on_header_end": self._end_header,
            "on_part_data": self._data,
            "on_part_end": self._end,
            "on_end": self._close,
        }
        super().__init__(boundary, heard)
        self.found: list[tuple[str, int, int]] = []
        self._is_closed = False
        self._place = place
        self._begin()

    def finalize(self) -> None:
        """Raises FormParserError where the form does not end."""
        super().finalize()
        if not self._is_closed:
            raise FormParserError("its last boundary is missing")

    def _close(self) -> None:
        self._is_closed = True

    def _begin(self) -> None:
        self._options: dict[bytes, bytes] = {}
        self._named, self._told, self._first = b"", b"", self._place.size

    def _name_header(self, data: bytes, start: int, end: int) -> None:
        self._named += data[start:end]

    def _value_header(self, data: bytes, start: int, end: int) -> None:
        self._told += data[start:end]

    def _end_header(self) -> None:
        if self._named.lower() == b"content-disposition":
            _, self._options = parse_options_header(self._told)
        self._named, self._told = b"", b""

    def _data(self, data: bytes, start: int, end: int) -> None:
        if self._is_file():
            self._place.add(memoryview(data)[start:end])

    def _end(self) -> None:
        if not self._is_file():
            return
        if len(self.found) == MOST_FILES:
            raise InvalidField(FIELD, MOST_FILES + 1, f"must be at most {MOST_FILES} files")
        self.found.append((_text(self._options.get(b"filename", b"")) or "file", self._first, self._place.size))

    def _is_file(self) -> bool:
        return self._options.get(b"name") == FIELD.encode()


def _text(name: bytes) -> str:
    try:
        return name.decode()
    except UnicodeDecodeError:
        return name.decode("latin-1")


def _missing() -> RequestValidationError:
    return RequestValidationError([{"type": "missing", "loc": ("body", FIELD), "msg": "Field required", "input": None}])
