"""Pictures of MiniGrid observations, predicted ones too: any code of the vocabulary can be drawn."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy.typing import NDArray

from workers.simulators.minigrid_rules import AGENT, BALL, BOX, CONTENTS, EMPTY, FLOOR, GOAL, KEY, WALL, Code

COLOURS = ("#d62728", "#2ca02c", "#1f55c4", "#8e44ad", "#e0b000", "#8a8a8a")  # red, green, blue, purple, yellow, grey
WRONG = "#ff0000"
HAND = (0, 0)  # row and column of the corner, always a wall, where the carried object is drawn
Codes = NDArray[np.uint8]


def draw_observation(axes: Axes, grid: Codes, carried: Codes, truth: tuple[Codes, Codes] | None = None) -> int:
    """grid (S, S, 3), carried (3,); the hand stands in the corner at the top left.

    truth: the true grid and carried object; elements that differ from it are outlined. Says how many do.
    """
    size, wrong = len(grid), 0
    for row in range(size):
        for column in range(size):
            _draw_code(axes, row, column, _code(grid[row, column]))
            if truth is not None and (row, column) != HAND and (grid[row, column] != truth[0][row, column]).any():
                wrong += _outline(axes, row, column)
    _draw_hand(axes, _code(carried))
    if truth is not None and ((carried != truth[1]).any() or (grid[HAND] != truth[0][HAND]).any()):
        wrong += _outline(axes, *HAND)
    axes.set(xlim=(-0.02, size + 0.02), ylim=(size + 0.02, -0.02), xticks=[], yticks=[], aspect="equal")
    return wrong


def _code(element: Codes) -> Code:
    kind, colour, state = element.tolist()
    return kind, colour, state


def _draw_hand(axes: Axes, code: Code) -> None:
    row, column = HAND
    axes.add_patch(Rectangle((column, row), 1, 1, facecolor="#fff6d5", edgecolor="black", linewidth=0.8))
    if code[0] != EMPTY:
        _draw_thing(axes, row, column, code)


def _draw_code(axes: Axes, row: int, column: int, code: Code) -> None:
    """The cell's ground, and what stands on it."""
    kind, colour, _ = code
    ground = {WALL: "#6b6b6b", GOAL: "#9be59b", FLOOR: COLOURS[colour]}.get(kind, "#ffffff")
    alpha = 0.35 if kind == FLOOR else 1.0
    axes.add_patch(Rectangle((column, row), 1, 1, facecolor=ground, alpha=alpha, linewidth=0))
    axes.add_patch(Rectangle((column, row), 1, 1, fill=False, edgecolor="#c8c8c8", linewidth=0.4))
    if kind not in (EMPTY, WALL, GOAL, FLOOR):
        _draw_thing(axes, row, column, code)


def _draw_thing(axes: Axes, row: int, column: int, code: Code) -> None:
    kind, colour, state = code
    x, y, paint = column + 0.5, row + 0.5, COLOURS[colour]
    if kind == KEY:
        axes.add_patch(Circle((x, y - 0.18), 0.15, fill=False, edgecolor=paint, linewidth=1.6))
        axes.add_patch(
            Polygon([(x, y - 0.03), (x, y + 0.34), (x + 0.16, y + 0.34)], closed=False, fill=False, ec=paint)
        )
    elif kind == BALL:
        axes.add_patch(Circle((x, y), 0.28, color=paint, linewidth=0))
    elif kind == BOX:
        axes.add_patch(Rectangle((x - 0.36, y - 0.36), 0.72, 0.72, fill=False, edgecolor=paint, linewidth=1.8))
        if state in CONTENTS:
            inside, inner, _ = CONTENTS[state]
            axes.text(x, y, "k" if inside == KEY else "b", color=COLOURS[inner], ha="center", va="center", size=7)
    elif kind == AGENT and state < 4:
        turn = np.array([[0, -1], [1, 0]])  # a quarter clockwise, rows going down
        tip = np.array([(0.36, 0.0), (-0.3, 0.28), (-0.3, -0.28)]) @ np.linalg.matrix_power(turn, state).T
        axes.add_patch(Polygon(tip + np.array((x, y)), color=paint, linewidth=0))
    else:
        axes.text(x, y, "?", color=paint, ha="center", va="center", size=8)  # a code that no room has


def _outline(axes: Axes, row: int, column: int) -> int:
    box = Rectangle((column + 0.05, row + 0.05), 0.9, 0.9, fill=False, edgecolor=WRONG, linewidth=1.8, zorder=5)
    axes.add_patch(box)
    return 1
