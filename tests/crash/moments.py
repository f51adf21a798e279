"""The moment in which a file appears: obstore writes NAME#n and renames it, and a kill in between is what we want."""

import ctypes
import os
import select
import struct
import time
from pathlib import Path
from typing import Self

CREATED = 0x100  # IN_CREATE, inotify(7)
HEADER = struct.Struct("iIII")  # watch, mask, cookie, length of the name
LIBC = ctypes.CDLL(None, use_errno=True)


class Appearances:
    """Tells of files that are made in the folders of one kind of blobs, at once and without polling."""

    def __init__(self, folder: Path) -> None:
        self._handle = LIBC.inotify_init1(os.O_CLOEXEC | os.O_NONBLOCK)
        if self._handle < 0:
            raise OSError(ctypes.get_errno(), "inotify_init1")
        for number in range(256):  # the two first digits of a hash; made by whoever comes first
            place = folder / f"{number:02x}"
            place.mkdir(parents=True, exist_ok=True)
            if LIBC.inotify_add_watch(self._handle, str(place).encode(), CREATED) < 0:
                raise OSError(ctypes.get_errno(), f"inotify_add_watch {place}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._handle)

    def forget(self) -> None:
        """What has appeared so far does not count."""
        while self._names(0.0):
            pass

    def await_staging(self, seconds: float) -> bool:
        """Wait for the next file that is being written; False where none came."""
        deadline = time.monotonic() + seconds
        while (remaining := deadline - time.monotonic()) > 0:
            if any("#" in name for name in self._names(remaining)):
                return True
        return False

    def _names(self, seconds: float) -> list[str]:
        ready, _, _ = select.select([self._handle], [], [], seconds)
        if not ready:
            return []
        data, place, names = os.read(self._handle, 65536), 0, []
        while place < len(data):
            length = HEADER.unpack_from(data, place)[3]
            place += HEADER.size
            names.append(data[place : place + length].rstrip(b"\0").decode())
            place += length
        return names
