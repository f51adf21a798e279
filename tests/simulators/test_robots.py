"""What the robot simulators promise beyond the contract: what is observed, and what is refused in which words."""

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from workers.simulators.base import OptionError, Simulator, SimulatorError, SimulatorUnavailable, StateError
from workers.simulators.catalog import behavior_names, make_behavior, make_simulator
from workers.simulators.maniskill import ManiSkillSimulator
from workers.simulators.robosuite import RobosuiteSimulator

ROBOTS = ("robosuite", "maniskill")
STILL = np.zeros(7, np.float32)


def make(name: str, **options: object) -> Simulator:
    try:
        return make_simulator(name, options)
    except SimulatorUnavailable as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def numbers() -> Iterator[Mapping[str, Simulator]]:
    """A simulator of each package, without cameras."""
    made = {name: make(name, cameras=False, horizon=9) for name in ROBOTS}
    yield made
    for simulator in made.values():
        simulator.close()


@pytest.fixture(params=ROBOTS)
def robot(request: pytest.FixtureRequest, numbers: Mapping[str, Simulator]) -> Simulator:
    return numbers[request.param]


def test_proprioception_is_where_the_hand_is_how_it_is_turned_and_how_far_it_is_open(robot: Simulator) -> None:
    seen = robot.reset(0)["proprioception"]
    rotation = seen[3:9].reshape(2, 3)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(2), atol=1e-5)
    assert np.cross(*rotation)[2] < -0.9  # the hand points down
    assert ((seen[9:] >= 0) & (seen[9:] <= 0.0401)).all()
    for _ in range(4):
        lifted = robot.step(np.array([0, 0, 1, 0, 0, 0, 0], np.float32)).observation["proprioception"]
    assert lifted[2] > seen[2] + 0.02


def test_without_cameras_the_objects_are_told_in_numbers(numbers: Mapping[str, Simulator]) -> None:
    cube = numbers["robosuite"].reset(0)["objects"]
    assert cube.shape == (9,)
    assert 0.8 < cube[2] < 0.85  # on the table
    cube, goal = numbers["maniskill"].reset(0)["objects"].reshape(2, 9)
    np.testing.assert_allclose(cube[:2] - goal[:2], [0.2, 0], atol=1e-6)
    np.testing.assert_allclose(cube[3:], [1, 0, 0, 0, 1, 0], atol=1e-6)


def test_an_episode_is_truncated_at_its_horizon(robot: Simulator) -> None:
    robot.reset(0)
    steps = [robot.step(STILL) for _ in range(9)]
    assert [step.truncated for step in steps] == [False] * 8 + [True]
    assert not any(step.terminated for step in steps)


def test_a_task_that_stays_solved_for_three_steps_ends_its_episode(numbers: Mapping[str, Simulator]) -> None:
    simulator = numbers["maniskill"]
    simulator.reset(0)
    state = simulator.state()
    cube, goal = state["objects"]
    cube[:2] = goal[:2]
    simulator.restore(state)
    assert [simulator.step(STILL).terminated for _ in range(3)] == [False, False, True]


@pytest.mark.parametrize("action", [[0.0] * 6, [2.0] + [0.0] * 6, [np.nan] + [0.0] * 6, 3])
def test_an_action_outside_the_space_is_refused(robot: Simulator, action: object) -> None:
    robot.reset(0)
    before = robot.state()
    with pytest.raises(SimulatorError, match=r"7 numbers from -1 to 1, but it is"):
        robot.step(np.array(action))
    assert all(np.array_equal(before[name], array) for name, array in robot.state().items())


def test_a_state_of_another_version_is_refused_with_both_versions(robot: Simulator) -> None:
    robot.reset(0)
    state = robot.state()
    state["version"][1] = 9
    with pytest.raises(StateError, match=r"'version' is of task .* 9\.\d+\.\d+ .*, but this is task .* [13]\.\d+\.\d+"):
        robot.restore(state)


def test_a_state_of_another_task_is_refused(robot: Simulator) -> None:
    robot.reset(0)
    state = robot.state()
    state["version"][0] = 2
    with pytest.raises(StateError, match=r"task (NutAssemblySquare|LiftPegUpright) .* this is task (Lift|PullCube) "):
        robot.restore(state)


def test_a_state_that_is_no_number_is_refused(robot: Simulator) -> None:
    robot.reset(0)
    state = robot.state()
    name = "physics" if "physics" in state else "joints"
    state[name].flat[3] = np.nan
    with pytest.raises(StateError, match=f"State '{name}' holds a number that is not finite, at "):
        robot.restore(state)


def test_a_simulation_that_breaks_down_is_named(
    numbers: Mapping[str, Simulator], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    robosuite, maniskill = numbers["robosuite"], numbers["maniskill"]
    assert isinstance(robosuite, RobosuiteSimulator)
    assert isinstance(maniskill, ManiSkillSimulator)
    robosuite.reset(0)
    robosuite.env.sim.data.qvel[0] = np.nan
    with pytest.raises(SimulatorError, match=r"'robosuite', task 'Lift', computed a number .* not finite in step 1"):
        robosuite.step(STILL)
    maniskill.reset(0)
    maniskill.env.agent.robot._objs[0].set_qvel(np.full(9, np.nan, np.float32))
    with pytest.raises(SimulatorError, match=r"'maniskill', task 'PullCube', broke down in step 1 .*not finite"):
        maniskill.step(STILL)
    for simulator in (robosuite, maniskill):
        simulator.reset(0)
        simulator.step(STILL)  # and all is well again
    assert not list(tmp_path.iterdir())  # MuJoCo would leave a log where the process runs


@pytest.mark.parametrize("name", ROBOTS)
def test_a_simulator_that_is_not_installed_says_which_command_installs_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("robosuite", "mani_skill.envs"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SimulatorUnavailable, match="Run `make setup-robots`"):
        make_simulator(name, {})
    assert "random" in behavior_names(name)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_machine_that_cannot_draw_says_so(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = make(name)

    def no_context(width: int, height: int) -> None:
        raise RuntimeError(f"no context of {width} x {height}")

    monkeypatch.setattr("mujoco.GLContext", no_context)
    with pytest.raises(SimulatorUnavailable, match=r"cannot draw here \(no context of 256 x 256\)"):
        simulator.reset(0)
    simulator.close()


def test_simulators_beside_each_other_draw_what_they_draw_alone() -> None:
    first, second = make("robosuite", task="Lift"), make("maniskill", task="PokeCube")
    alone = first.reset(0), second.reset(0)
    third = make("maniskill", task="PullCube")
    third.reset(0)
    third.close()  # frees its own textures and no other's
    del third
    second.close()  # and draws again all the same
    beside = first.observe(), second.observe()
    for one, other in zip(alone, beside, strict=True):
        assert all(np.array_equal(one[name], other[name]) for name in one)
    first.close()
    second.close()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"task": "Stack"}, "'task' must be one of .*, but it is 'Stack'"),
        ({"task": ["Lift"]}, r"'task' .*\['Lift'\]"),
        ({"cameras": 1}, "'cameras' must be true or false, but it is 1"),
        ({"horizon": 0}, "'horizon' must be an integer from 1 to 1000000, but it is 0"),
        ({"colour": "red"}, "has no option 'colour'; its options are task, cameras, horizon"),
    ],
)
@pytest.mark.parametrize("name", ROBOTS)
def test_an_option_out_of_range_is_named_with_its_value(name: str, options: dict[str, object], sentence: str) -> None:
    with pytest.raises(OptionError, match=sentence):
        make_simulator(name, options)


def test_an_unknown_behavior_is_named_beside_the_known_ones(robot: Simulator) -> None:
    with pytest.raises(OptionError, match=r"'clever'.*random"):
        make_behavior("clever", robot)


@pytest.mark.parametrize("name", ["expert", "random"])
def test_a_behavior_repeats_itself_and_leaves_the_simulator_alone(robot: Simulator, name: str) -> None:
    runs = []
    for _ in range(2):
        behavior, rng = make_behavior(name, robot), np.random.default_rng(3)
        robot.reset(4)
        behavior.reset(rng)
        actions = []
        for _ in range(4):
            before = robot.state()
            actions.append(np.asarray(behavior.act(robot, rng)))
            assert all(np.array_equal(before[key], array) for key, array in robot.state().items())
            robot.step(actions[-1])
        runs.append(np.stack(actions))
    np.testing.assert_array_equal(runs[0], runs[1])


def test_random_actions_fill_the_space_and_repeat_themselves(robot: Simulator) -> None:
    drawn = []
    for _ in range(2):
        behavior, rng = make_behavior("random", robot), np.random.default_rng(3)
        behavior.reset(rng)
        drawn.append(np.array([behavior.act(robot, rng) for _ in range(500)]))
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert all(robot.action_space.contains(action) for action in drawn[0])
    assert (np.abs(drawn[0].mean(axis=0)) < 0.15).all()
    assert (np.abs(drawn[0]).max(axis=0) > 0.97).all()
