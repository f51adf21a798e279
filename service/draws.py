"""Draws by chance: held-out segments, and states to explore from. Seeded by the project and its last lease's token."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from api_schemas.environments import DiscreteActions
from api_schemas.labels import Action
from service import projects
from service.errors import ServiceError
from service.store.queries import pool as queries
from service.store.tables import ProjectRow


class PoolExhausted(ServiceError):
    """The pool has no segment left to give."""

    status_code = 409

    def __init__(self, asked: int, unlabeled: int, purpose: str) -> None:
        super().__init__(
            f"count: asked for {asked} segments, {unlabeled} are unlabeled and free in the {purpose} split"
        )


@dataclass(frozen=True)
class Candidate:
    """A segment about to be given out, or a state and the actions to execute there."""

    trajectory: str
    start: int
    score: float | None = None
    confidence: float | None = None
    actions: Sequence[Action] | None = None


def held_out(session: Session, project: ProjectRow, count: int, now: datetime) -> list[Candidate]:
    """`count` of the free held-out segments, uniformly."""
    taken = queries.taken_starts(session, project.id, "held_out", now)
    members = queries.members(session, project.id, "held_out")
    ends = np.cumsum([member.segments for member in members])
    busy = [
        before + start // project.stride
        for member, before in zip(members, [0, *ends[:-1].tolist()], strict=True)
        for start in taken.get(member.trajectory_id, ())
    ]
    free = np.delete(np.arange(ends[-1]), busy)
    chosen = _generator(project).choice(free, count, replace=False)
    return [Candidate(*_segment(project, members, ends, int(place))) for place in chosen]


@dataclass(frozen=True)
class States:
    """Members of the pool whose observations can be gone back to; `ends` counts their segments up to each, (M,)."""

    members: Sequence[queries.Member]
    ends: NDArray[np.int64]

    @property
    def count(self) -> int:
        """How many states there are."""
        return int(self.ends[-1]) if len(self.ends) else 0

    def at(self, project: ProjectRow, place: int) -> tuple[str, int]:
        """Trajectory and observation of the state at this place among all."""
        return _segment(project, self.members, self.ends, place)


def states(session: Session, project: ProjectRow, last: int | None = None) -> States:
    """What can be explored from. It takes a while in a large pool, and needs no lock: members stay.

    Where the project has a simulator only trajectories whose simulator states are kept can be gone back to. last: the
    pool as it was when this membership was the youngest.
    """
    members = queries.members(session, project.id, "pool", with_provenance=_simulated(project), last=last)
    return States(members, np.cumsum([member.segments for member in members], dtype=np.int64))


def newest_explorable(session: Session, project: ProjectRow) -> int:
    """The youngest membership that holds such states; 0 where none does. It looks from the youngest back."""
    return queries.newest_with_segments(session, project.id, "pool", with_provenance=_simulated(project))


def explorations(project: ProjectRow, states: States, count: int) -> list[Candidate]:
    """`count` of the states and a segment's worth of actions for each, both uniform; none where there is no state."""
    if not states.count:
        return []
    rng = _generator(project)
    places = rng.integers(0, states.count, count)
    segments = [states.at(project, int(place)) for place in places]
    return [Candidate(*segment, actions=_actions(project, rng)) for segment in segments]


def _simulated(project: ProjectRow) -> bool:
    return projects.environment_of(project).simulator is not None


def _segment(
    project: ProjectRow, members: Sequence[queries.Member], ends: NDArray[np.int64], place: int
) -> tuple[str, int]:
    """Trajectory and start of the segment at this place of the split."""
    number = int(np.searchsorted(ends, place, side="right"))
    before = int(ends[number]) - members[number].segments
    return members[number].trajectory_id, (place - before) * project.stride


def _actions(project: ProjectRow, rng: np.random.Generator) -> list[Action]:
    space = projects.spaces_of(project).actions
    if isinstance(space, DiscreteActions):
        return [int(action) for action in rng.integers(0, space.n, project.segment_length)]
    size = (project.segment_length, int(np.prod(space.shape)))
    return [[float(value) for value in row] for row in rng.uniform(space.low, space.high, size)]


def _generator(project: ProjectRow) -> np.random.Generator:
    return np.random.default_rng([project.seed, project.token])
