"""MiniGrid's objects of the room, one shared instance for each code."""

import os

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # minigrid imports pygame, which greets on stdout

import numpy as np
from minigrid.core.constants import COLORS, IDX_TO_COLOR
from minigrid.core.world_object import Ball, Box, Floor, Goal, Key, Wall, WorldObj
from minigrid.utils import rendering
from numpy.typing import NDArray

from workers.simulators.minigrid_rules import (
    BALL,
    BLUE,
    BOX,
    CONTENTS,
    FLOOR,
    GOAL_CODE,
    GREY,
    KEY,
    NOTHING,
    RED,
    WALL_CODE,
    Code,
)


class FillableBox(Box):
    """A box whose contents show, in its code and as a small mark in its picture."""

    def __init__(self, color: str, contents: int) -> None:
        super().__init__(color)
        self.contents = contents

    def encode(self) -> Code:
        """MiniGrid's code with the contents as the state."""
        kind, color, _ = super().encode()
        return kind, color, self.contents

    def render(self, img: NDArray[np.uint8]) -> None:  # type: ignore[override]  # MiniGrid draws in place, returns None
        """Draws the box, and a disc (ball) or a bar (key) of the content's colour in its upper half."""
        super().render(img)  # type: ignore[no-untyped-call]  # minigrid has no types here
        if self.contents:
            kind, color, _ = CONTENTS[self.contents]
            _draw_mark(img, kind == BALL, COLORS[IDX_TO_COLOR[color]])


def _draw_mark(img: NDArray[np.uint8], is_disc: bool, color: NDArray[np.int64]) -> None:
    inside = _in_disc if is_disc else _in_bar
    rendering.fill_coords(img, inside, color)  # type: ignore[no-untyped-call]  # minigrid has no types here


def _in_disc(x: float, y: float) -> bool:
    return (x - 0.5) ** 2 + (y - 0.33) ** 2 <= 0.1**2


def _in_bar(x: float, y: float) -> bool:
    return 0.3 <= x <= 0.7 and 0.28 <= y <= 0.38


def _objects() -> dict[Code, WorldObj | None]:
    """One shared object of each code. They are never changed: a rule puts another one in the place."""
    objects: dict[Code, WorldObj | None] = {NOTHING: None, WALL_CODE: Wall(), GOAL_CODE: Goal()}
    for color in (RED, BLUE):
        name = IDX_TO_COLOR[color]
        ball = Ball(name)  # type: ignore[no-untyped-call]  # minigrid has no types here
        objects |= {(KEY, color, 0): Key(name), (BALL, color, 0): ball}
        objects |= {(BOX, color, contents): FillableBox(name, contents) for contents in (0, *CONTENTS)}
    return objects | {(FLOOR, color, 0): Floor(IDX_TO_COLOR[color]) for color in range(GREY + 1)}


OBJECTS = _objects()
CODES = {item: code for code, item in OBJECTS.items()}
PACKED = {item: bytes(code) for code, item in OBJECTS.items()}
