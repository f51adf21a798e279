"""The whole loop of a robot project as a user goes through it: create, collect, acquire, label, by the command line."""

import json

import pytest

from asim.client import Client
from tests.command import Command
from workers.simulators.base import SimulatorUnavailable
from workers.simulators.catalog import make_simulator

TASKS = {
    "Lift": ("robosuite", "false"),
    "PickPlaceCan": ("robosuite", "false"),
    "NutAssemblySquare": ("robosuite", "true"),
    "PullCube": ("maniskill", "true"),
    "PokeCube": ("maniskill", "false"),
    "LiftPegUpright": ("maniskill", "false"),
}


@pytest.fixture
def asim(url: str, command: Command, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Commands that ask the running service."""
    monkeypatch.setenv("ASIM_URL", url)
    return command


@pytest.mark.parametrize("task", TASKS)
def test_a_robot_task_is_collected_acquired_and_labeled(asim: Command, url: str, task: str) -> None:
    simulator, cameras = TASKS[task]
    try:
        make_simulator(simulator, {"task": task}).close()
    except SimulatorUnavailable as error:
        pytest.skip(str(error))
    options = [f"task={task}", f"cameras={cameras}", "horizon=4"]
    chosen = [word for option in options for word in ("--option", option)]
    asim("project", "create", task, "--simulator", simulator, *chosen, "--strategy", "random", "--label-budget", "6")
    told = asim("collect", task, "--transitions", "8", "--split", "pool").splitlines()[-1]
    assert json.loads(told)["transitions"] == 8
    with Client(url) as client:
        project = client.find_project(task)
        batch = client.acquire(project.id, 2, strategy="random")
        assert batch.token is not None
    asim("label", task, "--acquisition", str(batch.id), "--token", str(batch.token))
    if task in ("Lift", "PullCube"):  # each `asim label` starts a simulator of its own
        asim("label", task, "--count", "3", "--strategy", "random")
    with Client(url) as client:
        labels = list(client.labels(project.id))
        assert client.acquisition(batch.id).status == "labeled"
        assert client.find_project(task).budget.spent == len(labels) == (5 if task in ("Lift", "PullCube") else 2)
        streams = client.trajectory_content(project.id, labels[0].trajectory)
    assert [label.residual for label in labels] == [0.0] * len(labels)
    if cameras == "true":
        assert {name: stream.shape[1:] for name, stream in streams.items() if stream.dtype == "uint8"} == {
            "front": (64, 64, 3),
            "wrist": (64, 64, 3),
        }


def test_labels_cannot_be_asked_for_by_action_in_a_sentence(asim: Command) -> None:
    asim("project", "create", "boxes", "--simulator", "maniskill")
    said = asim("collect", "boxes", "--transitions", "8", "--labels-per-action", "2", status=1)
    assert (
        "labels.per_action: needs discrete actions to count by, and this project's are boxes of shape [7], got 2"
        in said
    )


def test_a_collection_in_shards_is_waited_for_and_summed_up(asim: Command, url: str) -> None:
    asim("project", "create", "shards", "--simulator", "minigrid", "--option", "max_steps=5")
    told = asim("collect", "shards", "--trajectories", "5", "--jobs", "2", "--split", "pool", "--seed", "3")
    assert json.loads(told.splitlines()[-1]) == {
        "trajectories": 5,
        "transitions": 25,
        "labels": {},
        "short_of": {},
        "known_before": 0,
    }
    with Client(url) as client:
        project = client.find_project("shards")
        assert (project.counts.pool_trajectories, project.counts.pool_segments) == (5, 25)
        assert [job.kind for job in client.jobs(project.id)] == ["collect", "collect"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ([], "give transitions or trajectories, and one of them only; got neither"),
        (["--trajectories", "2", "--labels", "some"], "--labels some: must be all, or a number of segments"),
        (["--trajectories", "2", "--labels", "all"], "labels.all: is for boxes"),
        (["--trajectories", "2", "--jobs", "3"], "shards: 3 of them cannot share 2 trajectories"),
    ],
)
def test_a_collection_that_cannot_be_is_refused_in_a_sentence(
    asim: Command, url: str, options: list[str], sentence: str
) -> None:
    with Client(url) as client:
        if not any(project.name == "refused" for project in client.projects()):
            asim("project", "create", "refused", "--simulator", "minigrid")
    assert sentence in asim("collect", "refused", *options, status=1)
