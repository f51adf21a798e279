"""The rules of the object room, asked through the simulator's observations."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tests.simulators.rooms import X, Y, code_at, make, place
from workers.simulators.base import SimulatorError, StateError
from workers.simulators.minigrid import (
    ACTION_NAMES,
    AGENT,
    BALL,
    BLUE,
    BOX,
    DROP,
    FLOOR,
    FORWARD,
    GOAL,
    KEY,
    LEFT,
    MOVEMENT,
    NOTHING,
    PICKUP,
    RED,
    RIGHT,
    SWAP,
    TASKS,
    TOGGLE,
    WALL,
    MiniGridOptions,
)
from workers.simulators.minigrid_layout import draw_room
from workers.simulators.minigrid_rules import GOAL_CODE, WALL_CODE, Code, is_effective
from workers.simulators.minigrid_tasks import is_solved

RED_KEY, BLUE_KEY, RED_BALL, BLUE_BALL = (KEY, RED, 0), (KEY, BLUE, 0), (BALL, RED, 0), (BALL, BLUE, 0)
RED_BOX, BLUE_BOX = (BOX, RED, 0), (BOX, BLUE, 0)
RED_BOX_BLUE_KEY, BLUE_BOX_RED_BALL = (BOX, RED, 2), (BOX, BLUE, 3)
TILE = (FLOOR, BLUE, 0)


def same(front: Code, carried: Code) -> tuple[Code, Code]:
    return front, carried


RULES: list[tuple[int, Code, Code, tuple[Code, Code]]] = [
    # action, front, carried, (front, carried) afterwards
    (PICKUP, RED_KEY, NOTHING, (NOTHING, RED_KEY)),
    (PICKUP, BLUE_BALL, NOTHING, (NOTHING, BLUE_BALL)),
    (PICKUP, RED_BOX, NOTHING, (NOTHING, RED_BOX)),
    (PICKUP, RED_BOX_BLUE_KEY, NOTHING, (NOTHING, RED_BOX_BLUE_KEY)),
    (PICKUP, RED_KEY, BLUE_BALL, same(RED_KEY, BLUE_BALL)),
    (PICKUP, NOTHING, NOTHING, same(NOTHING, NOTHING)),
    (PICKUP, NOTHING, RED_KEY, same(NOTHING, RED_KEY)),
    (PICKUP, GOAL_CODE, NOTHING, same(GOAL_CODE, NOTHING)),
    (PICKUP, WALL_CODE, NOTHING, same(WALL_CODE, NOTHING)),
    (DROP, NOTHING, RED_KEY, (RED_KEY, NOTHING)),
    (DROP, NOTHING, BLUE_BOX_RED_BALL, (BLUE_BOX_RED_BALL, NOTHING)),
    (DROP, NOTHING, NOTHING, same(NOTHING, NOTHING)),
    (DROP, RED_BALL, RED_KEY, same(RED_BALL, RED_KEY)),
    (DROP, RED_BOX, RED_KEY, same(RED_BOX, RED_KEY)),
    (DROP, GOAL_CODE, RED_KEY, same(GOAL_CODE, RED_KEY)),
    (DROP, WALL_CODE, RED_KEY, same(WALL_CODE, RED_KEY)),
    (TOGGLE, RED_KEY, NOTHING, (BLUE_KEY, NOTHING)),
    (TOGGLE, BLUE_KEY, RED_BOX, (RED_KEY, RED_BOX)),
    (TOGGLE, RED_BALL, BLUE_KEY, (BLUE_BALL, BLUE_KEY)),
    (TOGGLE, BLUE_BALL, NOTHING, (RED_BALL, NOTHING)),
    (TOGGLE, RED_BOX, BLUE_KEY, (RED_BOX_BLUE_KEY, NOTHING)),
    (TOGGLE, BLUE_BOX, RED_BALL, (BLUE_BOX_RED_BALL, NOTHING)),
    (TOGGLE, RED_BOX_BLUE_KEY, NOTHING, (RED_BOX, BLUE_KEY)),
    (TOGGLE, BLUE_BOX_RED_BALL, NOTHING, (BLUE_BOX, RED_BALL)),
    (TOGGLE, RED_BOX, NOTHING, same(RED_BOX, NOTHING)),
    (TOGGLE, RED_BOX, BLUE_BOX, same(RED_BOX, BLUE_BOX)),
    (TOGGLE, RED_BOX, BLUE_BOX_RED_BALL, same(RED_BOX, BLUE_BOX_RED_BALL)),
    (TOGGLE, RED_BOX_BLUE_KEY, RED_KEY, same(RED_BOX_BLUE_KEY, RED_KEY)),
    (TOGGLE, NOTHING, RED_KEY, same(NOTHING, RED_KEY)),
    (TOGGLE, GOAL_CODE, NOTHING, same(GOAL_CODE, NOTHING)),
    (SWAP, RED_KEY, BLUE_BALL, (BLUE_BALL, RED_KEY)),
    (SWAP, RED_BOX_BLUE_KEY, RED_BALL, (RED_BALL, RED_BOX_BLUE_KEY)),
    (SWAP, BLUE_KEY, BLUE_BOX_RED_BALL, (BLUE_BOX_RED_BALL, BLUE_KEY)),
    (SWAP, RED_BOX, BLUE_BOX, (BLUE_BOX, RED_BOX)),
    (SWAP, RED_KEY, NOTHING, same(RED_KEY, NOTHING)),
    (SWAP, NOTHING, RED_KEY, same(NOTHING, RED_KEY)),
    (SWAP, GOAL_CODE, RED_KEY, same(GOAL_CODE, RED_KEY)),
]


@pytest.mark.parametrize(("action", "front", "carried", "expected"), RULES)
def test_an_interaction_changes_what_the_rules_say_and_nothing_else(
    action: int, front: Code, carried: Code, expected: tuple[Code, Code]
) -> None:
    simulator = make()
    place(simulator, {(X + 1, Y): front, (1, 1): RED_BALL}, carried)
    wanted = simulator.observe()
    wanted["grid"][Y, X + 1], wanted["carried"][...] = expected
    step = simulator.step(action)
    np.testing.assert_array_equal(step.observation["grid"], wanted["grid"])
    np.testing.assert_array_equal(step.observation["carried"], wanted["carried"])
    assert not step.terminated
    assert is_effective(action, front, carried) == (expected != (front, carried))


def test_a_noisy_tile_takes_no_object_and_cannot_be_picked_up() -> None:
    for action, carried in ((DROP, RED_KEY), (PICKUP, NOTHING), (SWAP, RED_KEY)):
        simulator = make(noisy_tiles=1)
        place(simulator, {(X + 1, Y): TILE}, carried)
        observation = simulator.step(action).observation
        assert observation["grid"][Y, X + 1, 0] == FLOOR
        assert tuple(observation["carried"].tolist()) == carried


@pytest.mark.parametrize("front", [NOTHING, TILE])
def test_forward_moves_onto_empty_cells_and_tiles(front: Code) -> None:
    simulator = make()
    place(simulator, {(X + 1, Y): front})
    assert not simulator.step(FORWARD).terminated
    assert code_at(simulator, X + 1, Y) == (AGENT, RED, 0)
    assert code_at(simulator, X, Y) == NOTHING


@pytest.mark.parametrize("front", [RED_KEY, BLUE_BALL, RED_BOX, RED_BOX_BLUE_KEY, WALL_CODE])
def test_forward_is_blocked_by_objects_and_walls(front: Code) -> None:
    simulator = make()
    place(simulator, {(X + 1, Y): front})
    before = simulator.observe()
    np.testing.assert_array_equal(simulator.step(FORWARD).observation["grid"], before["grid"])


def test_turns_go_round_in_both_directions() -> None:
    simulator = make()
    place(simulator, {})
    assert [(simulator.step(RIGHT), code_at(simulator, X, Y)[2])[1] for _ in range(4)] == [1, 2, 3, 0]
    assert [(simulator.step(LEFT), code_at(simulator, X, Y)[2])[1] for _ in range(4)] == [3, 2, 1, 0]


def test_directions_are_right_down_left_up_on_row_and_column() -> None:
    for direction, (x, y) in enumerate(((X + 1, Y), (X, Y + 1), (X - 1, Y), (X, Y - 1))):
        simulator = make()
        place(simulator, {})
        for _ in range(direction):
            simulator.step(RIGHT)
        grid = simulator.step(FORWARD).observation["grid"]
        assert grid[y, x].tolist() == [AGENT, RED, direction]


def test_reaching_the_goal_ends_the_episode() -> None:
    simulator = make()
    place(simulator, {})
    steps = [simulator.step(a) for a in (FORWARD, FORWARD, RIGHT, FORWARD, FORWARD)]
    assert [step.terminated for step in steps] == [False] * 4 + [True]


def test_an_episode_is_truncated_at_its_last_step() -> None:
    simulator = make(max_steps=3)
    simulator.reset(0)
    assert [simulator.step(LEFT).truncated for _ in range(3)] == [False, False, True]


@pytest.mark.parametrize("action", [-1, 7, 2.0, np.array([1]), np.array(0.5)])
def test_an_action_outside_the_space_is_refused(action: int) -> None:
    simulator = make()
    simulator.reset(0)
    with pytest.raises(SimulatorError, match="from 0 to 6"):
        simulator.step(action)


@pytest.mark.parametrize("action", [RIGHT, np.array(RIGHT), np.int64(RIGHT), np.array(RIGHT, np.uint8)])
def test_an_action_may_be_any_integer_scalar(action: int) -> None:
    simulator = make()
    place(simulator, {})
    assert simulator.step(action).observation["grid"][Y, X, 2] == 1


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("agent", (0, 2, 0), r"'agent'.*\[0, 2, 0\]"),
        ("agent", (2, 2, 4), r"'agent'.*\[2, 2, 4\]"),
        ("cells", (5, 0, 0), r"'agent' stands on .*\(5, 0, 0\)"),
        ("carried", (9, 0, 0), r"\(9, 0, 0\)"),
        ("task", 3, "'task' must be below 3, but it is 3"),
    ],
)
def test_a_state_with_impossible_values_is_refused(name: str, value: object, sentence: str) -> None:
    simulator = make()
    simulator.reset(0)
    state = simulator.state()
    state[name][...] = np.asarray(value)
    with pytest.raises(StateError, match=sentence):
        simulator.restore(state)


def test_a_state_of_another_room_size_is_refused() -> None:
    large, small = make(room_size=8), make()
    large.reset(0)
    with pytest.raises(StateError, match=r"'cells' must be uint8 \(6, 6, 3\), but it is uint8 \(8, 8, 3\)"):
        small.restore(large.state())


@pytest.mark.parametrize("size", [6, 8])
@pytest.mark.parametrize("task", ["KeyDelivery", "BallDelivery", "ObjectMatching"])
def test_gymnasium_accepts_the_registered_environments(task: str, size: int) -> None:
    env = gym.make(f"ASIM/MiniGrid-{task}-{size}x{size}-v0")
    check_env(env.unwrapped)
    assert env.observation_space["grid"].shape == (size, size, 3)  # type: ignore[index]  # a Dict space
    env.close()


def test_a_room_has_walls_the_goal_at_the_bottom_right_and_the_objects_asked_for() -> None:
    for size, objects, tiles in ((6, 3, 0), (6, 3, 4), (8, 3, 2), (8, 8, 0), (8, 14, 4)):
        simulator = make(room_size=size, objects=objects, noisy_tiles=tiles)
        for seed in range(20):
            simulator.reset(seed)
            kinds = simulator.state()["cells"][..., 0]
            assert kinds[size - 2, size - 2] == GOAL
            assert (kinds == WALL).sum() == 4 * (size - 1)
            counts = [int((kinds == kind).sum()) for kind in (KEY, BALL, BOX)]
            assert sum(counts) == objects
            assert max(counts) - min(counts) <= 1
            assert (kinds == FLOOR).sum() == tiles


def test_layouts_directions_and_colours_vary() -> None:
    rooms = [draw_room(np.random.default_rng(seed), 6, TASKS[0], 3, 0) for seed in range(200)]
    assert len({room.position for room in rooms}) > 10
    assert {room.direction for room in rooms} == {0, 1, 2, 3}
    for kind in (KEY, BALL, BOX):
        assert {room.cells[room.find(kind)[0]][1] for room in rooms} == {RED, BLUE}


def test_the_option_any_draws_all_tasks_and_a_named_task_is_kept() -> None:
    simulator = make(task="any")
    drawn = []
    for seed in range(60):
        simulator.reset(seed)
        drawn.append(int(simulator.state()["task"]))
    assert set(drawn) == {0, 1, 2}
    simulator = make(task="object_matching")
    simulator.reset(0)
    assert TASKS[int(simulator.state()["task"])] == "object_matching"
    assert MiniGridOptions().max_steps == 120


def test_noisy_tiles_are_the_same_whatever_the_action() -> None:
    simulator = make(noisy_tiles=4)
    for seed in range(20):
        simulator.reset(seed)
        state = simulator.state()
        tiles = state["cells"][..., 0] == FLOOR
        after = []
        for action in range(len(ACTION_NAMES)):
            simulator.restore(state)
            simulator.step(action)
            after.append(simulator.state())
        assert all(np.array_equal(one["cells"][tiles], after[0]["cells"][tiles]) for one in after)
        assert all(np.array_equal(one["generator"], after[0]["generator"]) for one in after)


def test_a_noisy_tile_changes_colour_in_a_quarter_of_the_steps() -> None:
    simulator = make(noisy_tiles=4, max_steps=10**6)
    simulator.reset(0)
    tiles = simulator.state()["cells"][..., 0] == FLOOR
    colors = []
    for _ in range(2000):
        simulator.step(LEFT)
        colors.append(simulator.state()["cells"][tiles][:, 1])
    series = np.array(colors)  # (T, tiles)
    assert abs(np.mean(series[1:] != series[:-1]) - 0.25) < 0.02  # five standard deviations of 8,000 draws
    assert set(series.ravel().tolist()) == set(range(6))


def test_a_room_without_tiles_draws_nothing_while_it_is_played() -> None:
    simulator = make()
    simulator.reset(0)
    before = simulator.state()["generator"]
    for action in MOVEMENT:
        simulator.step(action)
    np.testing.assert_array_equal(simulator.state()["generator"], before)


def test_a_full_box_looks_different_from_an_empty_one_in_the_picture() -> None:
    simulator = make()
    pictures = []
    for contents in range(5):
        place(simulator, {(4, 1): (BOX, RED, contents)})
        pictures.append(simulator.render().tobytes())
    assert len(set(pictures)) == 5


SOLVED: list[tuple[str, dict[tuple[int, int], Code], Code, bool]] = [
    ("key_delivery", {(1, 1): RED_BALL}, (BOX, RED, 1), True),
    ("key_delivery", {(1, 1): BLUE_BALL}, (BOX, RED, 1), False),
    ("key_delivery", {(1, 1): RED_BALL}, RED_BOX_BLUE_KEY, False),
    ("key_delivery", {(1, 1): RED_BALL, (3, 3): (BOX, RED, 1)}, NOTHING, False),
    ("key_delivery", {(1, 1): RED_KEY}, (BOX, RED, 3), False),
    ("ball_delivery", {(1, 1): RED_KEY}, (BOX, RED, 3), True),
    ("ball_delivery", {(1, 1): BLUE_KEY}, (BOX, RED, 3), False),
    ("ball_delivery", {(1, 1): RED_BALL}, (BOX, RED, 1), False),
    ("object_matching", {(3, 3): BLUE_BOX, (4, 3): BLUE_KEY, (4, 2): BLUE_BALL}, NOTHING, True),
    ("object_matching", {(3, 3): BLUE_BOX, (4, 3): BLUE_KEY, (4, 1): BLUE_BALL}, NOTHING, False),
    ("object_matching", {(3, 3): BLUE_BOX, (4, 3): RED_KEY, (4, 2): BLUE_BALL}, NOTHING, False),
    ("object_matching", {(4, 3): RED_KEY, (4, 2): RED_BALL}, RED_BOX, False),
    ("object_matching", {(3, 3): RED_BOX, (4, 3): RED_KEY}, RED_BALL, False),
]


@pytest.mark.parametrize(("task", "objects", "carried", "expected"), SOLVED)
def test_a_task_is_solved_in_exactly_the_states_it_describes(
    task: str, objects: dict[tuple[int, int], Code], carried: Code, expected: bool
) -> None:
    simulator = make()
    place(simulator, objects, carried, task)
    assert is_solved(simulator.env.room()) == expected


def test_only_a_solved_episode_is_rewarded_at_the_goal() -> None:
    simulator = make()
    for contents, solved in ((1, True), (2, False)):
        place(simulator, {(1, 1): RED_BALL}, (BOX, RED, contents))
        outcomes = [simulator.env.step(a) for a in (FORWARD, FORWARD, RIGHT, FORWARD, FORWARD)]
        assert outcomes[-1][4] == {"is_success": solved}
        assert (float(outcomes[-1][1]) > 0) == solved
