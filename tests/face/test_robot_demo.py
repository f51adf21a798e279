"""The demo of each robot simulator, with a small plan and tiny networks, on a service and a runner of this process."""

import json
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from asim.demo import STRATEGIES, demo
from asim.demo_arm import Service
from asim.demo_plans import RobotPlan, plan_of
from asim.errors import AsimError
from models import families
from models.families import RobotFamily
from service.app import create_app
from service.clock import utc_now
from service.settings import Settings
from tests.command import Command
from tests.pages.canned_api import serving
from tests.science import toy_robot
from workers import runner
from workers.dispatch import open_worker
from workers.simulators.robot_packages import COMMAND

ROBOTS = ("robosuite", "maniskill")
QUEUES = ("train", "score", "default", "label")
BRIEF = {"world_model": toy_robot.SHORT}
TINY = replace(
    toy_robot.PRESET, training={**toy_robot.PRESET.training, **BRIEF}, further={**toy_robot.PRESET.further, **BRIEF}
)


def small(simulator: str) -> RobotPlan:
    """Poses in the place of pictures, whose networks would take minutes."""
    return RobotPlan(
        simulator,
        cameras=False,
        segment_length=4,
        seed_transitions=32,
        pool_transitions=48,
        test_transitions=16,
        batch_labels=5,
        batches=1,
    )


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """As a runner of its own has."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@contextmanager
def service(folder: Path) -> Iterator[Service]:
    """The API and one runner for all queues, in threads."""
    settings = Settings(data_folder=folder, job_lease_seconds=120.0)
    with serving(create_app(settings)) as port:
        worker = open_worker(settings, utc_now, QUEUES)
        thread = threading.Thread(target=runner.run, args=(worker,))
        thread.start()
        try:
            yield Service(f"http://127.0.0.1:{port}")
        finally:
            worker.stopping.set()
            thread.join()


@pytest.mark.parametrize("simulator", [pytest.param("robosuite", marks=pytest.mark.robots), "maniskill"])
def test_the_demo_of_a_robot_compares_two_arms_that_start_alike(
    simulator: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(families.PRESETS["robot"], "small", RobotFamily(TINY))
    monkeypatch.chdir(tmp_path)
    with service(tmp_path / "data") as running:
        try:
            demo(seed=3, keep=None, plan=small(simulator), service=running)
        except AsimError as error:
            if COMMAND not in str(error):
                raise
            pytest.skip(str(error))
    told = json.loads((tmp_path / "results" / f"demo-{simulator}-seed-3.json").read_text())
    assert set(told) == set(STRATEGIES)
    points = [[point["model_error"] for point in curve["points"]] for curve in told.values()]
    assert [len(each) for each in points] == [2, 2]
    assert points[0][0] == points[1][0]
    labels = [[point["labels"] for point in curve["points"]] for curve in told.values()]
    assert labels[0] == labels[1]
    assert labels[0][1] == labels[0][0] + 5
    for told_error in points[0]:
        end = told_error["open_loop"][-1]
        shares = [end["errors"][name] / end["standing_still"][name] for name in ("objects", "proprioception")]
        assert end["horizon"] == 4
        assert told_error["loss"] == pytest.approx(sum(shares) / 2)
    printed = capsys.readouterr().out
    for words in ("not foreseen", "proprioception, 4 steps", "of a prediction that nothing moves"):
        assert words in " ".join(printed.split())
    assert f"at {labels[0][1]} labels, confident_cycle's test loss" in printed
    assert f"at {labels[0][0]} labels, from which both went on, it was {points[0][0]['loss']:.4f}" in printed
    assert (tmp_path / "results" / f"demo-{simulator}-seed-3.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("simulator", ROBOTS)
def test_without_its_packages_the_demo_names_the_command_that_installs_them(
    simulator: str, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("robosuite", "mani_skill.envs"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.chdir(tmp_path)
    said = command("demo", "--simulator", simulator, "--keep", str(tmp_path / "data"), status=1)
    assert f"Run `{COMMAND}`" in said
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--simulator", "gazebo"], "--simulator gazebo: must be one of maniskill, minigrid, robosuite"),
        (["--task", "Lift"], "--task Lift: the demo on minigrid is of all its tasks"),
        (["--simulator", "maniskill", "--task", "Lift"], "options: task: Input should be 'PullCube'"),
    ],
)
def test_a_demo_that_there_is_not_is_refused_in_a_sentence(command: Command, words: list[str], sentence: str) -> None:
    assert sentence in command("demo", *words, status=1)


def test_a_demo_of_another_task_is_named_after_it() -> None:
    plan = plan_of("robosuite", "PickPlaceCan")
    assert plan.name == "demo-robosuite-PickPlaceCan"
    assert plan.project("can", "random", 0).environment.task() == "PickPlaceCan"
    with pytest.raises(AsimError, match="must be one of"):
        plan_of("mujoco", None)
