"""The benches of robot data: every recording is another, and a project at size is what its figures say."""

import numpy as np
import pytest

from benchmarks.service.recordings import EPISODES, STEPS, Recordings
from benchmarks.simulators.projects import measure
from benchmarks.simulators.speed import TASKS
from service.store import codec
from workers.simulators.base import SimulatorUnavailable
from workers.simulators.catalog import make_simulator

pytestmark = [pytest.mark.robots, pytest.mark.timeout(900)]


@pytest.fixture(autouse=True)
def _maniskill() -> None:
    try:
        make_simulator("maniskill", {}).close()
    except SimulatorUnavailable as error:
        pytest.skip(str(error))


def test_no_two_recordings_are_alike_and_all_compress_as_the_rendered_ones() -> None:
    recordings = Recordings()
    numbers = [*range(5 * EPISODES), 4000, 4999]
    made = [recordings.trajectory(number) for number in numbers]
    assert len({codec.content_id(arrays) for arrays in made}) == len(numbers)
    assert {arrays["front"].shape for arrays in made} == {(STEPS + 1, 64, 64, 3)}
    sizes = np.array([len(codec.encode(arrays)) for arrays in made])
    assert sizes[EPISODES:].mean() == pytest.approx(sizes[:EPISODES].mean(), rel=0.15)


def test_a_small_project_is_labeled_as_the_actions_were(capsys: pytest.CaptureFixture[str]) -> None:
    (task,) = [each for each in TASKS if each.name == "PullCube"]
    figures = {figure.name: figure for figure in measure(task, trajectories=2, segments=10)}
    assert figures["PullCube_replay_equal"].value == 10
    assert figures["PullCube_collected"].met
    assert figures["PullCube_search_gripper"].value == 1
