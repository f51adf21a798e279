"""The stored form of a trajectory and the npz of the exchange: what goes in comes out, and nothing else is read."""

import io
import json
import zipfile
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from safetensors.numpy import save

from service.store import codec, npz
from service.store.errors import ForeignFile
from tests.service.kit import npz as npz_file
from tests.service.kit import room, same

QUICK = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
LIMIT = 2**20


@st.composite
def trajectories(draw: st.DrawFn) -> dict[str, NDArray[Any]]:
    """One to three streams of any stored dtype and small shape, over up to 65 observations."""
    steps = draw(st.integers(1, 65))
    streams = {}
    for name in draw(st.lists(st.sampled_from(["grid", "cam", "joints"]), min_size=1, unique=True)):
        dtype = draw(st.sampled_from(["uint8", "int32", "int64", "float32", "float64"]))
        shape = draw(hnp.array_shapes(min_dims=0, max_dims=3, max_side=3))
        streams[name] = draw(hnp.arrays(dtype, (steps, *shape), fill=st.nothing() if steps < 3 else None))
    return streams


@QUICK
@given(trajectories(), st.data())
def test_any_window_comes_back_bit_by_bit(arrays: dict[str, NDArray[Any]], data: st.DataObject) -> None:
    steps = len(next(iter(arrays.values())))
    start = data.draw(st.integers(0, steps - 1))
    stop = data.draw(st.integers(start + 1, steps))
    decoded, extra = codec.decode(codec.encode(arrays, {"metadata": "who"}), "t", start, stop)
    assert same(decoded, {name: array[start:stop] for name, array in arrays.items()})
    assert extra == {"metadata": "who"}


def test_an_image_stream_is_many_frames_and_a_window_reads_across_them() -> None:
    images = np.random.default_rng(0).integers(0, 256, (101, 4, 4, 3), np.uint8)
    data = codec.encode({"cam": images})
    for start, stop in [(0, 101), (19, 21), (20, 40), (39, 61), (100, 101)]:
        assert same(codec.decode(data, "t", start, stop)[0], {"cam": images[start:stop]})


def test_the_id_names_the_content_and_not_its_layout() -> None:
    arrays = room(0)
    turned = {name: np.asfortranarray(array) for name, array in reversed(arrays.items())}
    assert codec.content_id(turned) == codec.content_id(arrays)
    assert same(codec.decode(codec.encode(turned), "t")[0], arrays)
    flat = {name: array.reshape(len(array), -1) for name, array in arrays.items()}
    assert codec.content_id(flat) != codec.content_id(arrays)
    wider = {name: array.astype(np.int32) for name, array in arrays.items()}
    assert codec.content_id(wider) != codec.content_id(arrays)


@QUICK
@given(st.floats(0, 1, exclude_max=True))
def test_a_truncated_object_is_refused_wherever_it_ends(share: float) -> None:
    data = codec.encode({"grid": room(0, 30)["grid"], "joints": np.zeros((31, 7), np.float32)})
    with pytest.raises(ForeignFile, match=r"torn\.bin"):
        codec.decode(data[: int(share * len(data))], "torn.bin")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"not a container at all",
        save({"grid": np.zeros(3, np.uint8)}),
        save({"grid": np.zeros(3, np.uint8)}, {"asim": "[]"}),
        save({"grid": np.zeros(3, np.uint8)}, {"asim": json.dumps({"format": "asim-trajectory", "version": 99})}),
        save({"grid": np.zeros(3, np.uint8)}, {"asim": json.dumps({"format": "weights", "version": 1})}),
        npz_file(room(0)),
    ],
)
def test_a_foreign_object_is_refused(data: bytes) -> None:
    with pytest.raises(ForeignFile, match=r"foreign\.bin"):
        codec.decode(data, "foreign.bin")


def test_a_damaged_frame_is_refused() -> None:
    data = bytearray(codec.encode({"grid": room(0, 30)["grid"]}))
    data[-40:] = bytes(40)
    with pytest.raises(ForeignFile, match="damaged"):
        codec.decode(bytes(data), "t")


@pytest.mark.parametrize("name", ["grid", "file", "allow_pickle", "args", "images/front"])
def test_npz_keeps_any_name_of_a_stream(name: str) -> None:
    arrays = {name: np.arange(6, dtype=np.int32).reshape(3, 2)}
    assert same(npz.parse(npz.dump(arrays), "t.npz", LIMIT), arrays)


def test_npz_metadata_is_no_stream() -> None:
    data = npz.dump({"grid": np.zeros((2, 3), np.uint8)}, "{}")
    assert list(npz.parse(data, "t.npz", LIMIT)) == ["grid"]
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        assert str(archive[npz.METADATA]) == "{}"


@settings(QUICK, max_examples=400)
@given(st.data())
def test_a_damaged_npz_is_refused_and_never_crashes(data: st.DataObject) -> None:
    whole = bytearray(npz_file(room(0, 2)))
    for place in data.draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=4)):
        whole[place] = data.draw(st.integers(0, 255))
    try:
        arrays = npz.parse(bytes(whole), "damaged.npz", LIMIT)
    except ForeignFile:
        return
    assert all(isinstance(array, np.ndarray) for array in arrays.values())


def test_a_member_that_is_no_array_is_refused() -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("grid", "a text and no array")
    with pytest.raises(ForeignFile, match=r"t\.npz.*magic"):
        npz.parse(buffer.getvalue(), "t.npz", LIMIT)


def test_a_member_that_promises_more_than_it_holds_is_refused() -> None:
    header = io.BytesIO()
    npz.npy.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (10**15,)})
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("grid.npy", header.getvalue() + bytes(100))
    with pytest.raises(ForeignFile, match=r"t\.npz"):
        npz.parse(buffer.getvalue(), "t.npz", LIMIT)


def test_a_locked_archive_is_refused() -> None:
    data = bytearray(npz_file({"grid": np.zeros((2, 3), np.uint8)}))
    local, central = data.find(b"PK\x03\x04"), data.find(b"PK\x01\x02")
    data[local + 6] |= 1  # the flag of encryption, in both headers
    data[central + 8] |= 1
    with pytest.raises(ForeignFile, match=r"t\.npz"):
        npz.parse(bytes(data), "t.npz", LIMIT)
