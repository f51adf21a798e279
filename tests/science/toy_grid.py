"""A small object room in the grid observation code, vectorised over rooms: data whose rules are known.

Actions 0 left, 1 right, 2 forward, 3 pickup, 4 drop, 5 toggle, 6 swap. Size 5 counts the walls; one key or ball and
one box; the agent may carry a key or a ball.
"""

import numpy as np
import torch
from numpy.typing import NDArray

from models.families import DiscreteAction, Spaces, StreamSpec
from models.segments import Observations, Segment, SegmentBatch

SIZE, ACTIONS = 5, 7
SPACES = Spaces({"grid": StreamSpec((SIZE, SIZE, 3), "uint8"), "carried": StreamSpec((3,), "uint8")}, DiscreteAction(7))
GROUPS = {"movement": {0, 1, 2}, "interaction": {3, 4, 5, 6}}
EMPTY, WALL, KEY, BALL, BOX, AGENT, BLUE = 1, 2, 5, 6, 7, 10, 2
STEPS = np.array(((0, 1), (1, 0), (0, -1), (-1, 0)))
Codes = NDArray[np.uint8]


def rooms(count: int, rng: np.random.Generator) -> tuple[Codes, Codes]:
    """Random states: grid (B, 5, 5, 3), carried (B, 3)."""
    grid = np.zeros((count, SIZE, SIZE, 3), np.uint8)
    grid[..., 0] = WALL
    grid[:, 1:-1, 1:-1, 0] = EMPTY
    places = np.argsort(rng.random((count, 9)), 1)[:, :3]  # three different interior cells
    rows, columns = places // 3 + 1, places % 3 + 1
    every = np.arange(count)
    grid[every, rows[:, 0], columns[:, 0]] = _things(count, rng)
    boxes = np.stack([np.full(count, BOX), BLUE * rng.integers(0, 2, count), rng.integers(0, 5, count)], 1)
    grid[every, rows[:, 1], columns[:, 1]] = boxes
    facing = np.stack([np.full(count, AGENT), np.zeros(count), rng.integers(0, 4, count)], 1)
    grid[every, rows[:, 2], columns[:, 2]] = facing
    carried = np.where(rng.random((count, 1)) < 0.5, _things(count, rng), np.array((EMPTY, 0, 0)))
    return grid, carried.astype(np.uint8)


def step(grid: Codes, carried: Codes, actions: NDArray[np.int64]) -> tuple[Codes, Codes]:
    """The next states of B rooms under B actions."""
    grid, hand = grid.copy(), carried.copy()
    every = np.arange(len(grid))
    flat = (grid[..., 0] == AGENT).reshape(len(grid), -1).argmax(1)
    row, column = flat // SIZE, flat % SIZE
    direction = grid[every, row, column, 2].astype(int)
    turned = (direction + np.select([actions == 0, actions == 1], [3, 1], 0)) % 4
    ahead = (row + STEPS[direction, 0], column + STEPS[direction, 1])
    front, thing, full = grid[every, *ahead], grid[every, *ahead, 0], hand[:, 0] != EMPTY
    free, loose, nothing = thing == EMPTY, np.isin(thing, (KEY, BALL, BOX)), np.array((EMPTY, 0, 0))
    contents = (hand[:, 0] - KEY) * 2 + hand[:, 1] // BLUE + 1
    inside = front[:, 2].astype(int) - 1
    taken = np.stack([KEY + inside // 2, BLUE * (inside % 2), 0 * inside], 1)
    flip = (actions == 5) & np.isin(thing, (KEY, BALL))
    fill = (actions == 5) & (thing == BOX) & (front[:, 2] == 0) & np.isin(hand[:, 0], (KEY, BALL))
    take = (actions == 5) & (thing == BOX) & (front[:, 2] > 0) & ~full
    pick, swap = (actions == 3) & loose & ~full, (actions == 6) & loose & full
    drop, move = (actions == 4) & free & full, (actions == 2) & free
    grid[every, row, column, 2] = turned
    new_front, new_hand = front.copy(), hand.copy()
    new_front[flip, 1] = BLUE - front[flip, 1]
    new_front[fill, 2], new_hand[fill] = contents[fill], nothing
    new_front[take, 2], new_hand[take] = 0, taken[take]
    new_front[pick], new_hand[pick] = nothing, front[pick]
    new_front[drop], new_hand[drop] = hand[drop], nothing
    new_front[swap], new_hand[swap] = hand[swap], front[swap]
    new_front[move] = grid[every, row, column][move]
    grid[every, *ahead] = new_front
    grid[every[move], row[move], column[move]] = nothing
    return grid, new_hand


def labeled(count: int, seed: int, effective: bool = False) -> SegmentBatch:
    """`count` transitions under uniform actions, with all action sets; `effective` ones only on request."""
    rng = np.random.default_rng(seed)
    grid, carried = rooms(count * (4 if effective else 1), rng)
    actions = rng.integers(0, ACTIONS, len(grid))
    after = step(grid, carried, actions)
    if effective:
        keep = np.nonzero((after[0] != grid).any((1, 2, 3)) | (after[1] != carried).any(1))[0][:count]
        grid, carried, actions, after = grid[keep], carried[keep], actions[keep], (after[0][keep], after[1][keep])
    sets = [_same(step(grid, carried, np.full(len(grid), action)), after) for action in range(ACTIONS)]
    return SegmentBatch(
        pairs(grid, carried, after),
        torch.from_numpy(actions).unsqueeze(1),
        torch.from_numpy(np.stack(sets, 1)).unsqueeze(1),
        tuple(Segment(f"toy-{seed}", start) for start in range(len(grid))),
    )


def pairs(grid: Codes, carried: Codes, after: tuple[Codes, Codes]) -> Observations:
    """Observations (B, 2, ...) of one transition each."""
    return {
        "grid": torch.from_numpy(np.stack((grid, after[0]), 1)),
        "carried": torch.from_numpy(np.stack((carried, after[1]), 1)),
    }


def _things(count: int, rng: np.random.Generator) -> Codes:
    colours = BLUE * rng.integers(0, 2, count)
    things: Codes = np.stack([rng.integers(KEY, BALL + 1, count), colours, np.zeros(count)], 1).astype(np.uint8)
    return things


def _same(left: tuple[Codes, Codes], right: tuple[Codes, Codes]) -> NDArray[np.bool_]:
    return np.asarray((left[0] == right[0]).all((1, 2, 3)) & (left[1] == right[1]).all(1))
