"""The three tasks of appendix B.1 and when each is solved.

`is_solved` looks at the current state only, never at how it came about; an episode succeeds if its task is solved in
the state in which the agent reaches the goal. With more than three objects one box, key and ball that fit are enough.

* key_delivery: the agent carries a box that holds a key of the box's colour, a ball of that colour lies in the room.
  (The box got into the hand by being swapped with the ball, which then lies where the box was.)
* ball_delivery: the same with key and ball in each other's place.
* object_matching: a box lies in the room with a key and a ball, both of its colour, among the eight cells around it.
"""

from workers.simulators.minigrid_room import Room
from workers.simulators.minigrid_rules import BALL, BOX, CONTENT_STATES, KEY

MISSIONS = {
    "key_delivery": "put a key into the box of its colour, swap the box with a ball of that colour, go to the goal",
    "ball_delivery": "put a ball into the box of its colour, swap the box with a key of that colour, go to the goal",
    "object_matching": "put a key and a ball of the box's colour around the box, go to the goal",
}

DELIVERIES = {"key_delivery": (KEY, BALL), "ball_delivery": (BALL, KEY)}
"""Of each delivery the kind that goes into the box and the kind that the box is swapped with."""


def is_solved(room: Room) -> bool:
    """Whether the room's task is solved, the way to the goal aside."""
    if room.task in DELIVERIES:
        return _is_delivered(room, *DELIVERIES[room.task])
    return any(_is_matched(room, box) for box in room.find(BOX))


def _is_delivered(room: Room, content: int, other: int) -> bool:
    kind, color, contents = room.carried
    is_loaded = kind == BOX and contents == CONTENT_STATES[content, color, 0]
    return is_loaded and (other, color, 0) in room.cells


def _is_matched(room: Room, box: int) -> bool:
    color = room.cells[box][1]
    around = [room.cells[position] for position in room.around(box)]
    return (KEY, color, 0) in around and (BALL, color, 0) in around
