"""The compositional split of the paper's Table 2: which object-action pairs are trained on and which are held out.

                  red key   blue key   red ball   blue ball
    pickup        absent    seen       absent     held out
    drop          absent    held out   absent     seen
    toggle        held out  seen       seen       held out
    swap for box  absent    held out   absent     seen

A transition belongs to the object that its action is about: pickup to the one in front, drop to the carried one, toggle
to the key or ball in front, swap to the key or ball that changes places with a box. Swapping a key for a ball is about
both and stands in no cell of the table: absent. So is toggling a box, which puts a key or ball inside or takes it out
and switches no colour. A box that is picked up or dropped is about a box alone, whatever it holds: neutral, like
movement and like an action that changes nothing.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.paper.minigrid.datasets import check_seed, data_digest, grid_spaces, kept
from models.segments import SegmentBatch
from workers.episodes import Episode, new_episodes
from workers.simulators.base import Simulator
from workers.simulators.catalog import make_behavior, make_simulator
from workers.simulators.minigrid_rules import (
    ACTION_NAMES,
    AGENT,
    BALL,
    BLUE,
    BOX,
    DROP,
    INTERACTION,
    KEY,
    PICKUP,
    RED,
    SWAP,
    TOGGLE,
    Code,
)

Coverage = Literal["seen", "held_out", "neutral", "absent"]
Draw = Literal["balanced", "uniform"]

ROOM, OBJECTS = 6, 3
SPACES = grid_spaces(ROOM)
POOL = 28_000  # transitions at natural frequency that uniform labels are drawn from
MOST = 1_000_000  # transitions after which a balanced draw gives up
STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0))  # (row, column) of direction right, down, left, up

TABLE: dict[tuple[int, int, int], Coverage] = {
    (PICKUP, KEY, BLUE): "seen",
    (PICKUP, BALL, BLUE): "held_out",
    (DROP, BALL, BLUE): "seen",
    (DROP, KEY, BLUE): "held_out",
    (TOGGLE, KEY, BLUE): "seen",
    (TOGGLE, BALL, RED): "seen",
    (TOGGLE, KEY, RED): "held_out",
    (TOGGLE, BALL, BLUE): "held_out",
    (SWAP, BALL, BLUE): "seen",
    (SWAP, KEY, BLUE): "held_out",
}
"""By (action, object, colour); what is not here is absent."""


@dataclass(frozen=True)
class Transition:
    """A step of an episode, and all actions that lead to what was observed next."""

    episode: Episode
    start: int
    explained: tuple[int, ...]

    @property
    def action(self) -> int:
        """The one that was taken."""
        return int(self.episode.actions[self.start])


def coverage(action: int, front: Code, carried: Code) -> Coverage:
    """Where an effective action stands in the table, by the cell in front and the carried object before it."""
    if action not in INTERACTION:
        return "neutral"
    if action == SWAP:
        things = [code for code in (front, carried) if code[0] != BOX]
        if len(things) != 1:
            return "absent" if things else "neutral"
        return TABLE.get((SWAP, *things[0][:2]), "absent")
    kind, colour, _ = carried if action == DROP else front
    if kind == BOX:
        return "absent" if action == TOGGLE else "neutral"
    return TABLE.get((action, kind, colour), "absent")


def coverage_of(episode: Episode, start: int) -> Coverage:
    """Of the transition at `start`, from its observations and its action. One that changes nothing is neutral."""
    grid, carried = episode.observations["grid"], episode.observations["carried"]
    if (grid[start] == grid[start + 1]).all() and (carried[start] == carried[start + 1]).all():
        return "neutral"
    return coverage(episode.actions[start], front_of(grid[start]), code_of(carried[start]))


def front_of(grid: NDArray[np.uint8]) -> Code:
    """The cell that the agent of a grid (S, S, 3) faces."""
    row, column = np.argwhere(grid[..., 0] == AGENT)[0]
    down, right = STEPS[grid[row, column, 2]]
    return code_of(grid[row + down, column + right])


def code_of(element: NDArray[np.uint8]) -> Code:
    """An element (3,) as plain integers."""
    kind, colour, state = element.tolist()
    return kind, colour, state


def training_set(seed: int, labels: int, draw: Draw, folder: Path) -> SegmentBatch:
    """`labels` transitions that are seen or neutral; with the same seed a smaller set is part of a larger one.

    balanced: effective ones, as many of each action. uniform: each transition of a pool at natural frequency is as
    likely as any other, also those that change nothing, whose label is the set of all actions that explain them.
    """
    check_seed(seed)
    path = folder / f"composition-{draw}-{labels}-{seed}-{data_digest()}.npz"
    return kept(path, lambda: _batch(_uniform(seed, labels) if draw == "uniform" else _seen(seed, labels)))


def _seen(seed: int, labels: int) -> list[Transition]:
    shares = [labels // len(ACTION_NAMES) + (a < labels % len(ACTION_NAMES)) for a in range(len(ACTION_NAMES))]
    return _balanced(seed, shares, {"seen", "neutral"})


def test_set(seed: int, per_action: int, folder: Path) -> SegmentBatch:
    """Effective transitions, as many of each action: interactions that are held out, and movement, which is neutral."""
    check_seed(seed)
    path = folder / f"composition-test-{per_action}-{seed}-{data_digest()}.npz"
    return kept(path, lambda: _batch(_held_out(seed, per_action)))


def _held_out(seed: int, per_action: int) -> list[Transition]:
    shares = [per_action] * len(ACTION_NAMES)
    return _balanced(seed, shares, {"held_out", "neutral"}, held_out_interactions=True)


def _balanced(
    seed: int, shares: list[int], allowed: set[Coverage], held_out_interactions: bool = False
) -> list[Transition]:
    """The first effective transitions of each action, in the order of the episodes. Raises RuntimeError after MOST."""
    simulator, missing, taken = _simulator(), list(shares), []
    for episode, start in _steps(simulator, "balanced", MOST, seed):
        action = episode.actions[start]
        kind = coverage_of(episode, start) if missing[action] else "absent"
        if kind not in allowed or (held_out_interactions and action in INTERACTION and kind != "held_out"):
            continue
        if (explained := episode.explained(simulator, start)) == [action]:
            taken.append(Transition(episode, start, tuple(explained)))
            missing[action] -= 1
            if not any(missing):
                return taken
    raise RuntimeError(f"{MOST} transitions of seed {seed} lack {missing} of the actions {ACTION_NAMES}.")


def _uniform(seed: int, labels: int) -> list[Transition]:
    simulator = _simulator()
    steps = list(_steps(simulator, "mixture", POOL, seed))
    order = np.random.default_rng(seed).permutation(len(steps))
    allowed = [steps[place] for place in order if coverage_of(*steps[place]) in ("seen", "neutral")][:labels]
    if len(allowed) < labels:
        raise RuntimeError(f"A pool of {POOL} transitions has {len(allowed)} to label, {labels} were asked for.")
    return [Transition(episode, start, tuple(episode.explained(simulator, start))) for episode, start in allowed]


def _steps(simulator: Simulator, behavior: str, transitions: int, seed: int) -> Iterator[tuple[Episode, int]]:
    for episode in new_episodes(simulator, make_behavior(behavior, simulator), transitions, seed):
        for start in range(episode.transitions):
            yield episode, start


def _simulator() -> Simulator:
    return make_simulator("minigrid", {"room_size": ROOM, "objects": OBJECTS})


def _batch(transitions: list[Transition]) -> SegmentBatch:
    """Segments of one transition each, with their actions and action sets."""
    sets = torch.zeros(len(transitions), 1, len(ACTION_NAMES), dtype=torch.bool)
    for row, transition in enumerate(transitions):
        sets[row, 0, list(transition.explained)] = True
    pairs: dict[str, NDArray[Any]] = {
        name: np.stack([t.episode.observations[name][t.start : t.start + 2] for t in transitions])
        for name in ("grid", "carried")
    }
    actions = torch.tensor([[transition.action] for transition in transitions])
    return SegmentBatch({name: torch.from_numpy(pair) for name, pair in pairs.items()}, actions, sets)
