"""The integer code of MiniGrid observations and the rules of the object room, as pure functions on that code.

A cell, and likewise the carried object, is three integers (object, colour, state); objects and colours are MiniGrid's
own. State is the direction of the agent, the contents of a box, and 0 of everything else.
"""

Code = tuple[int, int, int]

EMPTY, WALL, FLOOR, KEY, BALL, BOX, GOAL, AGENT = 1, 2, 3, 5, 6, 7, 8, 10
RED, GREEN, BLUE, PURPLE, YELLOW, GREY = range(6)
RIGHT_FACING, DOWN_FACING, LEFT_FACING, UP_FACING = range(4)
CHANNEL_SIZES = (11, 6, 5)
"""How many values the object, colour and state channels can take."""

LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE, SWAP = range(7)
ACTION_NAMES = ("left", "right", "forward", "pickup", "drop", "toggle", "swap")
MOVEMENT = (LEFT, RIGHT, FORWARD)
INTERACTION = (PICKUP, DROP, TOGGLE, SWAP)

NOTHING: Code = (EMPTY, 0, 0)
"""An empty cell and an empty hand."""
GOAL_CODE: Code = (GOAL, GREEN, 0)
WALL_CODE: Code = (WALL, GREY, 0)

CONTENTS: dict[int, Code] = {1: (KEY, RED, 0), 2: (KEY, BLUE, 0), 3: (BALL, RED, 0), 4: (BALL, BLUE, 0)}
"""What a box holds, by its state; state 0 is an empty box."""
CONTENT_STATES: dict[Code, int] = {code: state for state, code in CONTENTS.items()}

OTHER_COLOR = {RED: BLUE, BLUE: RED}


def is_movable(code: Code) -> bool:
    """Whether the agent can pick it up: keys, balls and boxes, full boxes too."""
    return code[0] in (KEY, BALL, BOX)


def is_passable(code: Code) -> bool:
    """Whether the agent can walk onto it. Walking onto the goal ends the episode."""
    return code[0] in (EMPTY, FLOOR, GOAL)


def interact(action: int, front: Code, carried: Code) -> tuple[Code, Code]:
    """The cell in front and the carried object after an interaction; both as they were if it has no effect.

    Pickup needs an empty hand, drop an empty cell (a floor tile takes no object), swap an object on both sides.
    """
    if action == PICKUP and carried == NOTHING and is_movable(front):
        return NOTHING, front
    if action == DROP and front == NOTHING:
        return carried, NOTHING
    if action == SWAP and is_movable(front) and is_movable(carried):
        return carried, front
    if action == TOGGLE:
        return toggle(front, carried)
    return front, carried


def toggle(front: Code, carried: Code) -> tuple[Code, Code]:
    """A key or ball in front changes between red and blue, whatever is carried. An empty box takes in a carried key or
    ball, never a box; a full box gives its contents to an empty hand. Nothing else changes."""
    kind, color, contents = front
    if kind in (KEY, BALL):
        return (kind, OTHER_COLOR[color], 0), carried
    if kind == BOX and contents == 0 and carried in CONTENT_STATES:
        return (BOX, color, CONTENT_STATES[carried]), NOTHING
    if kind == BOX and contents != 0 and carried == NOTHING:
        return (BOX, color, 0), CONTENTS[contents]
    return front, carried


def is_effective(action: int, front: Code, carried: Code) -> bool:
    """Whether the action changes anything but the colours of noisy tiles. A turn always does."""
    if action == FORWARD:
        return is_passable(front)
    return action in (LEFT, RIGHT) or interact(action, front, carried) != (front, carried)
