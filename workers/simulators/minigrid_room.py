"""The state of an object room as scripted players and task definitions read it."""

from dataclasses import dataclass
from functools import cached_property

from workers.simulators.base import State
from workers.simulators.minigrid_rules import GOAL, NOTHING, Code, is_effective

TASKS = ("key_delivery", "ball_delivery", "object_matching")


@dataclass(frozen=True)
class Room:
    """One moment. A position is `row * size + column`; with walls all around, a step adds one of `offsets` to it."""

    size: int
    cells: tuple[Code, ...]  # S*S in reading order, without the agent
    carried: Code
    position: int
    direction: int
    task: str

    @classmethod
    def from_state(cls, state: State) -> "Room":
        """Reads a state of the MiniGrid simulator."""
        size = state["cells"].shape[0]
        kinds, colors, states = state["cells"].reshape(-1, 3).T.tolist()
        x, y, direction = state["agent"].tolist()
        kind, color, contents = state["carried"].tolist()
        cells = tuple(zip(kinds, colors, states, strict=True))
        return cls(size, cells, (kind, color, contents), y * size + x, direction, TASKS[int(state["task"])])

    @cached_property
    def offsets(self) -> tuple[int, int, int, int]:
        """What a step right, down, left, up adds to a position."""
        return (1, self.size, -1, -self.size)

    @property
    def front(self) -> int:
        """The position that the agent faces."""
        return self.position + self.offsets[self.direction]

    @property
    def is_empty_handed(self) -> bool:
        """Whether the agent carries nothing."""
        return self.carried == NOTHING

    def find(self, kind: int) -> list[int]:
        """The positions of all objects of a kind."""
        return [position for position, code in enumerate(self.cells) if code[0] == kind]

    @cached_property
    def goal(self) -> int:
        """The position of the goal."""
        return self.find(GOAL)[0]

    def around(self, position: int) -> tuple[int, ...]:
        """The eight positions around one that is not on the wall."""
        return tuple(
            position + down + right for down in (-self.size, 0, self.size) for right in (-1, 0, 1) if down or right
        )

    def is_effective(self, action: int) -> bool:
        """Whether the action would change more than the colours of noisy tiles."""
        return is_effective(action, self.cells[self.front], self.carried)
