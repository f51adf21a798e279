"""The solvers solve, and the behaviors have the action statistics they were made for."""

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.simulators.rooms import make, place
from workers.simulators.catalog import make_behavior
from workers.simulators.minigrid import INTERACTION, MOVEMENT, TASKS
from workers.simulators.minigrid_experts import expert_action
from workers.simulators.minigrid_paths import open_cell
from workers.simulators.minigrid_rules import BALL, BLUE, BOX, KEY, NOTHING, PICKUP, RED, SWAP, Code

LAYOUTS = 200


def _is_success(simulator_options: dict[str, object], seed: int, noise: float = 0.0) -> bool:
    simulator, rng = make(**simulator_options), np.random.default_rng(seed)
    simulator.reset(seed)
    while True:
        action = expert_action(simulator.env.room(), rng)
        if rng.random() < noise:
            action = int(rng.integers(7))
        _, _, terminated, truncated, info = simulator.env.step(action)
        if terminated or truncated:
            return bool(info.get("is_success"))


def _effective(name: str, steps: int, **options: object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Counts of the chosen actions and of the effective ones among them, (7,) each."""
    simulator, rng = make(**options), np.random.default_rng(1)
    behavior = make_behavior(name, simulator)
    chosen, effective = np.zeros(7), np.zeros(7)
    seed = 0
    while chosen.sum() < steps:
        before = simulator.reset(seed)
        behavior.reset(rng)
        seed, is_over = seed + 1, False
        while not is_over:
            action = int(np.asarray(behavior.act(simulator, rng)))
            after, terminated, truncated = simulator.step(action)
            chosen[action] += 1
            effective[action] += any(not np.array_equal(before[key], after[key]) for key in before)
            before, is_over = after, terminated or truncated
    return chosen, effective


@pytest.mark.parametrize("size", [6, 8])
@pytest.mark.parametrize("task", TASKS)
def test_a_solver_solves_its_task_and_reaches_the_goal(task: str, size: int) -> None:
    successes = [_is_success({"task": task, "room_size": size}, seed) for seed in range(LAYOUTS)]
    assert np.mean(successes) >= 0.99


@pytest.mark.parametrize("task", TASKS)
def test_a_solver_recovers_from_random_actions(task: str) -> None:
    """One action in ten is random; the episode is lost only where one walks onto the goal or blocks the way."""
    successes = [_is_success({"task": task, "max_steps": 300}, seed, noise=0.1) for seed in range(100)]
    assert np.mean(successes) >= 0.9


CORNERED: list[tuple[str, dict[tuple[int, int], Code], Code]] = [
    # begun the wrong way: the wrong thing in the box, the box in the hand, a box in a corner
    ("key_delivery", {(1, 1): (BOX, RED, 4), (3, 1): (KEY, BLUE, 0)}, NOTHING),
    ("key_delivery", {(1, 1): (BOX, RED, 2), (3, 1): (BALL, RED, 0)}, NOTHING),
    ("ball_delivery", {(1, 1): (BALL, BLUE, 0), (3, 1): (KEY, BLUE, 0)}, (BOX, RED, 0)),
    ("object_matching", {(1, 1): (BOX, BLUE, 1), (3, 1): (BALL, RED, 0)}, NOTHING),
    ("object_matching", {(1, 1): (KEY, BLUE, 0)}, (BOX, RED, 4)),
    ("object_matching", {(1, 4): (BOX, BLUE, 0), (3, 1): (KEY, RED, 0)}, (BALL, RED, 0)),
]


@pytest.mark.parametrize(("task", "objects", "carried"), CORNERED)
def test_a_solver_undoes_what_was_begun_wrongly(task: str, objects: dict[tuple[int, int], Code], carried: Code) -> None:
    simulator, rng = make(), np.random.default_rng(0)
    place(simulator, objects, carried, task)
    for _ in range(120):
        _, _, terminated, _, info = simulator.env.step(expert_action(simulator.env.room(), rng))
        if terminated:
            break
    assert info == {"is_success": True}


def test_a_dropped_object_closes_no_way() -> None:
    """With the box at (3, 4) an object at (4, 3) would shut the goal at (4, 4) in."""
    simulator = make()
    place(simulator, {(3, 4): (BOX, RED, 0)}, (KEY, RED, 0), "object_matching")
    room = simulator.env.room()
    is_open = open_cell(room)
    assert not is_open(3 * room.size + 4)
    assert is_open(3 * room.size + 3)


def test_the_experts_swap_in_deliveries() -> None:
    _, effective = _effective("expert", 1000, task="key_delivery")
    assert effective[SWAP] > 0
    assert effective[PICKUP] > 0


def test_random_is_nine_tenths_movement_half_of_it_forward() -> None:
    chosen, _ = _effective("random", 10_000)
    share = chosen / chosen.sum()
    np.testing.assert_allclose(share[list(MOVEMENT)], [0.225, 0.225, 0.45], atol=0.02)
    np.testing.assert_allclose(share[list(INTERACTION)], 0.025, atol=0.01)


def test_effective_interactions_are_rare_in_the_mixture_and_all_occur() -> None:
    chosen, effective = _effective("mixture", 20_000)
    interactions = effective[list(INTERACTION)]
    assert 0.04 < interactions.sum() / chosen.sum() < 0.06
    assert (interactions > 50).all()


def test_the_balanced_behavior_makes_every_action_effective_often() -> None:
    chosen, effective = _effective("balanced", 10_000)
    assert effective.min() / chosen.sum() > 0.04
    assert effective[list(INTERACTION)].sum() / chosen.sum() > 0.2


def test_the_balanced_behavior_interacts_with_every_kind_and_colour() -> None:
    simulator, rng = make(), np.random.default_rng(0)
    behavior, seen = make_behavior("balanced", simulator), set()
    for seed in range(40):
        simulator.reset(seed)
        behavior.reset(rng)
        for _ in range(100):
            action, room = behavior.act(simulator, rng), simulator.env.room()
            if action in INTERACTION and room.is_effective(int(action)):
                front = room.cells[room.front]
                seen.add((int(action), *(room.carried if front == NOTHING else front)[:2]))
            if simulator.step(action).terminated:
                break
    assert seen == set(product(INTERACTION, (KEY, BALL, BOX), (RED, BLUE)))
