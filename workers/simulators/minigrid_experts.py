"""Solvers of the three tasks of appendix B.1. Each looks only at the current room and plans anew at every step, so that
it recovers from whatever else was done in between. A plan step is None where objects block the way to what it needs."""

from collections.abc import Callable

import numpy as np

from workers.simulators.minigrid_paths import approach, open_cell
from workers.simulators.minigrid_room import Room
from workers.simulators.minigrid_rules import (
    BALL,
    BOX,
    CONTENT_STATES,
    DROP,
    FORWARD,
    KEY,
    NOTHING,
    PICKUP,
    SWAP,
    TOGGLE,
    Code,
    is_movable,
)
from workers.simulators.minigrid_tasks import DELIVERIES, is_solved


def expert_action(room: Room, rng: np.random.Generator) -> int:
    """The next action towards solving the room's task and then reaching the goal.

    Where objects block the way (possible with more than three, or after another player's drops) a random action of
    `rng` is tried; otherwise `rng` is not used."""
    if is_solved(room):
        action = approach(room, lambda front: front == room.goal, FORWARD)
    elif room.task in DELIVERIES:
        action = _deliver(room, *DELIVERIES[room.task])
    else:
        action = _match(room)
    return int(rng.integers(7)) if action is None else action


def _deliver(room: Room, content: int, other: int) -> int | None:
    """Load a box with `content` of its colour, swap it with `other`, give `other` that colour."""
    box = _choose_box(room, content)
    if box is None:
        return _drop(room)
    kind_color = (content, box[1], 0)
    if box[2] == CONTENT_STATES[kind_color]:
        return _exchange(room, box, other)
    if box[2] != 0:
        return _unload(room, box)
    return _load(room, box, kind_color)


def _choose_box(room: Room, content: int) -> Code | None:
    """The box nearest to being loaded, one in the hand first: loaded, else empty, else any."""
    boxes = [code for code in (room.carried, *room.cells) if code[0] == BOX]
    ranks = {code: 0 if code[2] == CONTENT_STATES[content, code[1], 0] else 1 if code[2] == 0 else 2 for code in boxes}
    return min(boxes, key=ranks.__getitem__, default=None)


def _exchange(room: Room, box: Code, other: int) -> int | None:
    if room.carried == box:
        return _face(room, lambda code: code[0] == other, TOGGLE)
    if room.is_empty_handed:
        return _face(room, lambda code: code[0] == other, PICKUP)
    if room.carried[0] == other:
        return _face(room, lambda code: code == box, SWAP)
    return _drop(room)


def _unload(room: Room, box: Code) -> int | None:
    return _face(room, lambda code: code == box, TOGGLE) if room.is_empty_handed else _drop(room)


def _load(room: Room, box: Code, content: Code) -> int | None:
    if room.carried == content:
        return _face(room, lambda code: code == box, TOGGLE)
    if not room.is_empty_handed:
        return _drop(room)
    if content in room.cells:
        return _face(room, lambda code: code == content, PICKUP)
    return _face(room, lambda code: code[0] == content[0], TOGGLE)


def _match(room: Room) -> int | None:
    """Bring a key and a ball of the box's colour around the first box of the room."""
    boxes = room.find(BOX)
    if not boxes or room.carried[0] == BOX:
        return _drop_box(room) if is_movable(room.carried) else None
    box = room.cells[boxes[0]]
    missing = [kind for kind in (KEY, BALL) if (kind, box[1], 0) not in _codes_around(room, boxes[0])]
    if room.carried[0] in missing and room.carried[1] == box[1]:
        return _drop_around(room, boxes[0])
    if not room.is_empty_handed:
        return _drop(room)
    if _is_crowded(room, boxes[0], missing):
        return _face(room, lambda code: code == box, PICKUP)
    present = [kind for kind in missing if room.find(kind)]
    return _fetch(room, boxes[0], present[0]) if present else _unload(room, box)


def _fetch(room: Room, box: int, kind: int) -> int | None:
    """Give an object of the kind the box's colour, one around the box first; if it has that colour, pick it up."""
    wanted = (kind, room.cells[box][1], 0)
    around = [position for position in room.around(box) if room.cells[position][0] == kind]
    if around:
        return approach(room, around.__contains__, TOGGLE)
    if wanted in room.cells:
        return _face(room, lambda code: code == wanted, PICKUP)
    return _face(room, lambda code: code[0] == kind, TOGGLE)


def _codes_around(room: Room, box: int) -> list[Code]:
    return [room.cells[position] for position in room.around(box)]


def _face(room: Room, accept: Callable[[Code], bool], action: int) -> int | None:
    return approach(room, lambda front: accept(room.cells[front]), action)


def _drop(room: Room) -> int | None:
    """Put the carried object where it blocks nothing, or anywhere if there is no such place."""
    if not is_movable(room.carried):
        return None
    action = approach(room, open_cell(room), DROP)
    return _face(room, lambda code: code == NOTHING, DROP) if action is None else action


def _is_crowded(room: Room, box: int, missing: list[int]) -> bool:
    """Whether a box there leaves no cells around it for those missing kinds that do not lie there in any colour."""
    around = _codes_around(room, box)
    absent = [kind for kind in missing if kind not in [code[0] for code in around]]
    return around.count(NOTHING) < len(absent)


def _drop_box(room: Room) -> int | None:
    """Put the carried box where it blocks nothing and the key and the ball fit around it, if there is such a place."""
    is_open = open_cell(room)
    action = approach(room, lambda front: is_open(front) and not _is_crowded(room, front, [KEY, BALL]), DROP)
    return _drop(room) if action is None else action


def _drop_around(room: Room, box: int) -> int | None:
    """Put the carried object on a free cell around the box, rather one where it blocks nothing."""
    is_open, around = open_cell(room), room.around(box)
    action = approach(room, lambda front: front in around and is_open(front), DROP)
    if action is None:
        action = approach(room, lambda front: front in around and room.cells[front] == NOTHING, DROP)
    return _drop(room) if action is None else action
