"""Names and options: what is unknown or out of range is answered with a sentence that names it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from workers.simulators.base import OptionError
from workers.simulators.catalog import SIMULATORS, behavior_names, make_behavior, make_simulator


def test_an_unknown_simulator_is_named_beside_the_known_ones() -> None:
    with pytest.raises(OptionError, match=r"'mujoco'.*minigrid"):
        make_simulator("mujoco", {})
    with pytest.raises(OptionError, match="'mujoco'"):
        behavior_names("mujoco")


def test_an_unknown_behavior_is_named_beside_the_known_ones() -> None:
    with pytest.raises(OptionError, match=r"'clever'.*balanced, expert, mixture, random"):
        make_behavior("clever", make_simulator("minigrid", {}))


def test_an_unknown_option_is_named_beside_the_known_ones() -> None:
    with pytest.raises(OptionError, match=r"'rooms'.*task, room_size, objects, noisy_tiles, max_steps"):
        make_simulator("minigrid", {"rooms": 2})


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"task": "tidy_up"}, "'tidy_up'"),
        ({"task": ["any"]}, r"\['any'\]"),
        ({"room_size": 7}, "'room_size' must be 6 or 8, but it is 7"),
        ({"room_size": 16}, "'room_size'.*16"),
        ({"room_size": "6"}, "'room_size'.*'6'"),
        ({"room_size": 8, "objects": 15}, "'objects'.*15"),
        ({"room_size": 8, "objects": 2}, "'objects'.*2"),
        ({"room_size": 6, "objects": 4}, "'objects' must be 3 in a room of size 6, but it is 4"),
        ({"noisy_tiles": 5}, "'noisy_tiles'.*5"),
        ({"noisy_tiles": True}, "'noisy_tiles'.*True"),
        ({"max_steps": 0}, "'max_steps'.*0"),
    ],
)
def test_an_option_out_of_range_is_named_with_its_value(options: dict[str, object], sentence: str) -> None:
    with pytest.raises(OptionError, match=sentence):
        make_simulator("minigrid", options)


@pytest.mark.parametrize("name", behavior_names("minigrid"))
def test_a_behavior_repeats_itself_and_leaves_the_simulator_alone(name: str) -> None:
    runs = []
    for _ in range(2):
        simulator = make_simulator("minigrid", {"noisy_tiles": 2})
        behavior, rng = make_behavior(name, simulator), np.random.default_rng(3)
        simulator.reset(4)
        behavior.reset(rng)
        actions = []
        for _ in range(15):
            before = simulator.state()
            actions.append(int(np.asarray(behavior.act(simulator, rng))))
            after = simulator.state()
            assert all(np.array_equal(before[key], after[key]) for key in before)
            simulator.step(actions[-1])
        runs.append(actions)
    assert runs[0] == runs[1]


def test_the_catalog_imports_no_simulator_package_and_simulators_nothing_of_the_service() -> None:
    code = (
        "import sys, workers.simulators.catalog as c;"
        "assert not {'minigrid', 'pygame', 'mujoco', 'robosuite', 'sapien', 'mani_skill'} & set(sys.modules);"
        "c.make_simulator('minigrid', {});"
        "assert not {'torch', 'mujoco', 'sapien', 'service', 'models', 'api_schemas', 'asim'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, timeout=60, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""  # pygame's greeting would end up in a worker's output


def test_nothing_that_collects_labels_or_serves_knows_a_simulator_by_name() -> None:
    root = Path(__file__).parents[2]
    sources = [*(root / "workers").glob("*.py"), *(root / "service").rglob("*.py"), *(root / "asim/calls").glob("*.py")]
    assert len(sources) > 50
    named = [(path.name, name) for path in sources for name in SIMULATORS if name in path.read_text().lower()]
    assert named == []
