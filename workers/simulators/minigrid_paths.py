"""Ways through an object room: breadth-first search over the agent's positions and directions."""

from collections import deque
from collections.abc import Callable

from workers.simulators.minigrid_room import Room
from workers.simulators.minigrid_rules import EMPTY, FLOOR, FORWARD, GOAL, LEFT, NOTHING, RIGHT, is_movable


def approach(room: Room, accept: Callable[[int], bool], action: int) -> int | None:
    """The first action of a shortest way to face a position that `accept` takes, without crossing the goal;
    `action` itself if the agent faces one already; None if there is no way."""
    offsets, cells = room.offsets, room.cells
    queue: deque[tuple[int, int, int]] = deque([(room.position, room.direction, action)])
    seen = {(room.position, room.direction)}
    while queue:
        position, direction, first = queue.popleft()
        front = position + offsets[direction]
        if accept(front):
            return first
        is_start = (position, direction) == (room.position, room.direction)
        for move in (LEFT, RIGHT, FORWARD):
            pose = (front, direction) if move == FORWARD else (position, (direction + (1 if move == RIGHT else 3)) % 4)
            if pose not in seen and (move != FORWARD or cells[front][0] in (EMPTY, FLOOR)):
                seen.add(pose)
                queue.append((*pose, move if is_start else first))
    return None


def reach(room: Room, blocked: int | None = None) -> set[int]:
    """All positions the agent can stand on or touch without moving objects: walkable cells, and objects or the goal
    beside them. `blocked` counts as an object."""
    touched, queue = {room.position}, [room.position]
    while queue:
        position = queue.pop()
        for neighbor in (position + offset for offset in room.offsets):
            code = room.cells[neighbor]
            if neighbor in touched or not (code[0] in (EMPTY, FLOOR, GOAL) or is_movable(code)):
                continue
            touched.add(neighbor)
            if code[0] in (EMPTY, FLOOR) and neighbor != blocked:
                queue.append(neighbor)
    return touched


def open_cell(room: Room) -> Callable[[int], bool]:
    """A test whether an object can be dropped on a position so that all that could be reached still can."""
    before = reach(room)
    known: dict[int, bool] = {}

    def accept(position: int) -> bool:
        if room.cells[position] != NOTHING or position == room.position:
            return False
        if position not in known:
            known[position] = reach(room, blocked=position) >= before
        return known[position]

    return accept
