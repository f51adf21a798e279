"""The exchange format: npz with one array a stream. Never unpickled."""

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.store.errors import ForeignFile

npy: Any = np.lib.format  # it has no types
METADATA = "__metadata__"
MOST_MEMBERS = 66  # streams of an observation, and one of metadata
LONGEST_DIRECTORY = 2**16 + 22  # bytes: what zipfile looks for its end in; an entry takes 46 and more, ours about 130
LONGEST_HEADER = 1_000  # bytes; one of eight axes takes 200, and numpy takes 9 ms for a hostile one of 10,000
HEADERS = {(1, 0): (2, npy.read_array_header_1_0), (2, 0): (4, npy.read_array_header_2_0)}  # width of the length
BLOCK = 2**20
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
    return NpzFile(data, source, max_bytes).arrays()


@dataclass(frozen=True)
class Form:
    """What the header of a member promises. offset: of the data, behind the header."""

    member: zipfile.ZipInfo
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran: bool
    offset: int


class NpzFile:
    """A file whose headers are read and held against its sizes; data is unpacked on demand, once it is known to fit.

    forms: by stream. bytes: that the arrays take unpacked.
    """

    def __init__(self, content: bytes | memoryview, source: str, max_bytes: int) -> None:
        """Raises ForeignFile for what is no npz of plain arrays, or would unpack to more than `max_bytes`."""
        self._content, self.source = memoryview(content), source
        with self._reading(), _opened(self._content) as archive:
            members = archive.infolist()
            self.bytes = sum(info.file_size for info in members)
            if self.bytes > max_bytes:
                raise ForeignFile(source, f"unpacks to {self.bytes} bytes, {max_bytes} are allowed")
            named = {info.filename.removesuffix(".npy"): _form(archive, info) for info in members}
            if len(named) < len(members):
                raise ForeignFile(source, f"names a stream twice: {sorted(info.filename for info in members)}")
        self.forms = {name: form for name, form in named.items() if name != METADATA}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All streams, read-only. Raises ForeignFile."""
        with self._reading(), _opened(self._content) as archive:
            return {name: _array(archive, self._content, form) for name, form in self.forms.items()}

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except ForeignFile:
            raise
        except Exception as error:  # on bytes that are not theirs the parsers of zip and npy raise a dozen kinds
            raise ForeignFile(self.source, f"is not a whole npz file of plain arrays ({error})") from error


class _Opening:
    """Bytes as a file, of which no more than LONGEST_DIRECTORY is read at once until it `is_open`: zipfile reads the
    directory of an archive whole, however long it says that it is, and makes an object of each entry."""

    def __init__(self, content: memoryview) -> None:
        self._content, self._at, self.is_open = content, 0, False

    def read(self, size: int = -1) -> bytes:
        """Raises ValueError."""
        if not self.is_open and size > LONGEST_DIRECTORY:
            raise ValueError(f"a directory of {size} bytes, {LONGEST_DIRECTORY} are allowed")
        piece = bytes(self._content[self._at : None if size < 0 else self._at + size])
        self._at += len(piece)
        return piece

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Raises OSError."""
        at = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: len(self._content)}[whence] + offset
        if at < 0:
            raise OSError(f"a place {-at} bytes before the first")
        self._at = at
        return at

    def tell(self) -> int:
        """Where the next byte is read."""
        return self._at

    def seekable(self) -> bool:
        """It is."""
        return True


@contextmanager
def _opened(content: memoryview) -> Iterator[zipfile.ZipFile]:
    """The archive of few enough members. Raises ValueError."""
    opening = _Opening(content)
    with zipfile.ZipFile(opening) as archive:
        opening.is_open = True
        members = len(archive.infolist())
        if members > MOST_MEMBERS:
            raise ValueError(f"{members} members, {MOST_MEMBERS} are allowed")
        yield archive


def _form(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Form:
    """The header of one member, held against its size before anybody believes it. Raises ValueError."""
    if info.compress_type not in COMPRESSIONS:
        raise ValueError(f"{info.filename} has compression {info.compress_type}")
    with archive.open(info) as member:
        version = npy.read_magic(member)
        if version not in HEADERS:
            raise ValueError(f"{info.filename} has npy version {version}")
        width, read_header = HEADERS[version]
        told = member.read(width)
        length = int.from_bytes(told, "little")
        if length > LONGEST_HEADER:
            raise ValueError(f"{info.filename} has a header of {length} bytes, {LONGEST_HEADER} are allowed")
        shape, fortran, dtype = read_header(io.BytesIO(told + member.read(length)))
    offset = npy.MAGIC_LEN + width + length
    promised, held = math.prod(shape) * dtype.itemsize, info.file_size - offset
    if dtype.hasobject or promised != held:
        raise ValueError(f"{info.filename} promises {promised} bytes of {dtype} and holds {held}")
    return Form(info, shape, dtype, fortran, offset)


def _array(archive: zipfile.ZipFile, held: memoryview, form: Form) -> NDArray[Any]:
    """The data of one member. Raises ValueError."""
    is_stored = form.member.compress_type == zipfile.ZIP_STORED
    content = _stored(held, form.member) if is_stored else _inflated(archive, form.member)
    array: NDArray[Any] = np.ndarray(form.shape, form.dtype, content, form.offset, order="F" if form.fortran else "C")
    array = array if array.flags.aligned else array.copy("K")
    array.flags.writeable = False
    return array


def _stored(held: memoryview, member: zipfile.ZipInfo) -> memoryview:
    """A member that lies in the file as it is, behind a header of its own. Raises ValueError."""
    name, extra = struct.unpack_from("<HH", held, member.header_offset + 26)
    first = member.header_offset + 30 + name + extra
    content = held[first : first + member.compress_size]
    if len(content) != member.file_size or zlib.crc32(content) != member.CRC:
        raise ValueError(f"{member.filename} promises {member.file_size} bytes and holds others")
    return content


def _inflated(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytearray:
    """A member that zlib unpacks; zipfile compares its checksum. Raises ValueError."""
    content, held = bytearray(member.file_size), 0  # filled block by block: zlib would hold the whole twice
    with archive.open(member) as file:
        while block := file.read(
            min(BLOCK, len(content) - held)
        ):  # bounded: a lying member may hold more than its size
            content[held : held + len(block)] = block
            held += len(block)
    if held != len(content):
        raise ValueError(f"{member.filename} promises {len(content)} bytes and holds {held}")
    return content
