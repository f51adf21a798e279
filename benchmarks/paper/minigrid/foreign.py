"""Transitions in the layout of other MiniGrid code: one npz file of arrays, a row a transition.

    states, next_states    (N, H, W, 3), or (N, 1, 1, H, W, 3): object, colour, state of each cell; rooms are square
    carried, next_carried  (N, 2), or (N, 1, 1, 2): colour, object; (5, 1) is an empty hand
    actions                (N,): 0 to 6 are left, right, forward, pickup, drop, toggle, swap

Objects, colours and directions are MiniGrid's numbers. Which of the two room axes goes right is not written down
anywhere, and both are in use: the agents that walk forward tell. What is in a box that is carried is not visible there,
and in others' files not what is in any box; which other actions would have explained a step is not known.
"""

import hashlib
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from models.segments import Segment, SegmentBatch
from workers.simulators.minigrid import ACTION_NAMES, AGENT, CHANNEL_SIZES, EMPTY, FORWARD, GREY

NAMES = ("states", "carried", "actions", "next_states", "next_carried")
STEPS = np.array(((0, 1), (1, 0), (0, -1), (-1, 0)))  # (row, column) of direction right, down, left, up
Codes = NDArray[np.uint8]


class ForeignLayoutError(ValueError):
    """The file is not in the layout; the message names file, array and what is wrong with it."""


def read(path: Path) -> SegmentBatch:
    """Labeled segments of one transition each. Raises ForeignLayoutError."""
    arrays = _arrays(path)
    before, after = (_grid(path, name, arrays[name]) for name in ("states", "next_states"))
    hands = [_hand(path, name, arrays[name], len(before)) for name in ("carried", "next_carried")]
    actions = _actions(path, arrays["actions"], len(before))
    if before.shape != after.shape:
        raise ForeignLayoutError(f"{path}: next_states is {after.shape}, states is {before.shape}.")
    grid = np.stack((before, after), 1)  # (N, 2, H, W, 3)
    if _columns_come_first(grid, actions):
        grid = grid.swapaxes(2, 3)
    name = f"{path.stem}-{digest(path)}"
    return SegmentBatch(
        {"grid": torch.from_numpy(np.ascontiguousarray(grid)), "carried": torch.from_numpy(np.stack(hands, 1))},
        torch.from_numpy(actions).unsqueeze(1),
        segments=tuple(Segment(name, row) for row in range(len(actions))),
    )


def fits(batch: SegmentBatch) -> torch.Tensor:
    """Which segments the layout can hold, bool (B,): in all others a full box is carried."""
    return (batch.observations["carried"][..., 2] == 0).all(1)


def digest(path: Path) -> str:
    """Of what the file holds: results on it bear it, so that another file of the same name does not pass for it."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def write(batch: SegmentBatch, path: Path) -> None:
    """Labeled transitions (B, 1) in the layout, the first room axis going right as in MiniGrid's own encoding.

    Raises ValueError for longer segments, for unlabeled ones, and for a carried box whose contents would be lost.
    """
    if batch.actions is None or batch.length != 1:
        raise ValueError("The foreign layout holds labeled transitions, one a segment.")
    unfit = np.flatnonzero(~fits(batch).numpy())
    if unfit.size:
        raise ValueError(f"The foreign layout cannot hold segment {unfit[0]}: a full box is carried there.")
    grid, hand = batch.observations["grid"].numpy(), batch.observations["carried"].numpy()
    arrays = {"states": grid[:, 0], "next_states": grid[:, 1], "carried": hand[:, 0], "next_carried": hand[:, 1]}
    for name in ("states", "next_states"):
        arrays[name] = arrays[name].swapaxes(1, 2)
    for name in ("carried", "next_carried"):
        empty = arrays[name][:, :1] == EMPTY
        arrays[name] = np.where(empty, (GREY, EMPTY), arrays[name][:, 1::-1]).astype(np.uint8)
    np.savez_compressed(path, actions=batch.actions[:, 0].numpy(), **arrays)


def _arrays(path: Path) -> dict[str, NDArray[np.generic]]:
    try:
        with np.load(path) as file:
            missing = [name for name in NAMES if name not in file.files]
            if missing:
                raise ForeignLayoutError(f"{path} lacks the array {missing[0]!r}; it holds {', '.join(file.files)}.")
            return {name: file[name] for name in NAMES}
    except (OSError, ValueError) as error:
        if isinstance(error, ForeignLayoutError):
            raise
        raise ForeignLayoutError(f"{path} cannot be read as npz: {error}") from error


def _grid(path: Path, name: str, array: NDArray[np.generic]) -> Codes:
    if array.ndim == 6 and array.shape[1:3] == (1, 1):
        array = array[:, 0, 0]
    if array.ndim != 4 or array.shape[1] != array.shape[2] or array.shape[3] != 3:
        raise ForeignLayoutError(f"{path}: {name} must be (N, H, H, 3), it is {array.shape}.")
    return _codes(path, name, array, CHANNEL_SIZES)


def _hand(path: Path, name: str, array: NDArray[np.generic], count: int) -> Codes:
    if array.ndim == 4 and array.shape[1:3] == (1, 1):
        array = array[:, 0, 0]
    if array.shape != (count, 2):
        raise ForeignLayoutError(f"{path}: {name} must be ({count}, 2), it is {array.shape}.")
    codes = _codes(path, name, array, (CHANNEL_SIZES[1], CHANNEL_SIZES[0]))
    carried: Codes = np.stack(
        (codes[:, 1], codes[:, 0], np.zeros(count, np.uint8)), 1
    )  # colour, object -> object, colour
    carried[carried[:, 0] == EMPTY] = (EMPTY, 0, 0)
    return carried


def _codes(path: Path, name: str, array: NDArray[np.generic], sizes: tuple[int, ...]) -> Codes:
    for channel, size in enumerate(sizes):
        values = array[..., channel].astype(np.float64)
        bad = values[~((values >= 0) & (values < size) & (values == np.floor(values)))]
        if bad.size:
            raise ForeignLayoutError(f"{path}: {name}[..., {channel}] must be 0 to {size - 1}, it holds {bad[0]:g}.")
    codes: Codes = array.astype(np.uint8)
    return codes


def _actions(path: Path, array: NDArray[np.generic], count: int) -> NDArray[np.int64]:
    flat = array.reshape(-1).astype(np.float64)
    if len(flat) != count:
        raise ForeignLayoutError(f"{path}: actions must be ({count},), it is {array.shape}.")
    bad = flat[~np.isin(flat, range(len(ACTION_NAMES)))]
    if bad.size:
        raise ForeignLayoutError(f"{path}: actions must be 0 to {len(ACTION_NAMES) - 1}, it holds {bad[0]:g}.")
    return flat.astype(np.int64)


def _columns_come_first(grid: Codes, actions: NDArray[np.int64]) -> bool:
    """Whether more of the agents that walked went along the axes the other way round than ours."""
    walked = grid[actions == FORWARD]
    where = (walked[..., 0] == AGENT).reshape(len(walked), 2, -1)
    walked = walked[where.any(2).all(1)]
    size, place = grid.shape[2], (walked[..., 0] == AGENT).reshape(len(walked), 2, -1).argmax(2)  # (M, 2)
    moves = np.stack((place // size, place % size), 2)  # (M, 2, row and column)
    moved = moves[:, 1].astype(int) - moves[:, 0]
    facing = walked[:, 0].reshape(len(walked), -1, 3)[np.arange(len(walked)), place[:, 0], 2]
    step = STEPS[facing % len(STEPS)]
    ours, others = (moved == step).all(1).sum(), (moved == step[:, ::-1]).all(1).sum()
    return bool(others > ours)
