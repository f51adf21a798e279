"""Observations that come in: npz files held against a project's spaces, before and after they are unpacked."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from api_schemas.environments import Spaces, Stream
from service.errors import InvalidField
from service.store.errors import ForeignFile
from service.store.npz import NpzFile

Arrays = dict[str, NDArray[Any]]
BLOCK_NUMBERS = 2**20  # looked at together: a mask of a whole stream would double what the stream takes


class InvalidTrajectory(InvalidField):
    """A trajectory does not fit the project's observation space, or its arrays disagree."""


class Shaped(Protocol):
    """An array, or what a file says of one."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Time first."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of every number."""


def read(spaces: Spaces, files: Sequence[tuple[str, bytes | memoryview]], max_bytes: int) -> list[Arrays]:
    """The arrays of each file; what does not fit the spaces, or is too large, is refused before it is unpacked.

    files: with the name to call each by. max_bytes: that all together may unpack to.

    All of them are checked: who refuses one has stored none. Raises ForeignFile, InvalidTrajectory.
    """
    opened, total = [], 0
    for source, content in files:
        opened.append(NpzFile(content, source, max_bytes))
        total += opened[-1].bytes
        if total > max_bytes:
            raise ForeignFile(source, f"and the files before it unpack to {total} bytes, {max_bytes} are allowed")
        check_forms(spaces, opened[-1].forms, source)
    found = [file.arrays() for file in opened]
    for one, arrays in zip(opened, found, strict=True):
        check(spaces, arrays, one.source)
    return found


def check(spaces: Spaces, arrays: Mapping[str, NDArray[Any]], source: str) -> None:
    """Every stream there with its dtype and shape, equal lengths, two observations at least, finite numbers."""
    check_forms(spaces, arrays, source)
    for name, stream in spaces.observations.items():
        _check_values(arrays[name], stream, f"{source}: {name}")


def check_forms(spaces: Spaces, forms: Mapping[str, Shaped], source: str) -> None:
    """The streams, their dtypes, shapes and lengths. Raises InvalidTrajectory."""
    expected, found = sorted(spaces.observations), sorted(forms)
    if expected != found:
        raise InvalidTrajectory(f"{source}: streams", found, f"must be {expected}")
    for name, stream in spaces.observations.items():
        _check_form(forms[name], stream, f"{source}: {name}")
    lengths = {name: form.shape[0] for name, form in forms.items()}
    if len(set(lengths.values())) > 1:
        raise InvalidTrajectory(f"{source}: length", lengths, "must be the same for all streams")
    if min(lengths.values()) < 2:
        raise InvalidTrajectory(f"{source}: length", min(lengths.values()), "must be at least 2 observations")


def _check_form(form: Shaped, stream: Stream, name: str) -> None:
    if form.dtype != np.dtype(stream.dtype):
        raise InvalidTrajectory(f"{name}: dtype", form.dtype, f"must be {stream.dtype}")
    if form.shape[1:] != stream.shape or not form.shape:
        raise InvalidTrajectory(f"{name}: shape", form.shape, f"must be (T + 1, {', '.join(map(str, stream.shape))})")


def _check_values(array: NDArray[Any], stream: Stream, name: str) -> None:
    steps = max(1, BLOCK_NUMBERS // max(1, array[0].size))
    for first in range(0, len(array), steps):
        block = array[first : first + steps]
        if stream.high is not None:
            _refuse_where(block > np.asarray(stream.high), array, first, name, f"must be at most {stream.high}")
        if array.dtype.kind == "f":
            _refuse_where(~np.isfinite(block), array, first, name, "must be finite")


def _refuse_where(wrong: NDArray[np.bool_], array: NDArray[Any], first: int, name: str, reason: str) -> None:
    """wrong: (steps, ...) of the array's steps from `first` on."""
    if wrong.any():
        step, *place = (int(index) for index in np.argwhere(wrong)[0])
        where = (first + step, *place)
        raise InvalidTrajectory(f"{name}{list(where)}", array[where], reason)
