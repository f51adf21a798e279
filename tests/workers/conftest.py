"""Small prepared projects, made once and copied for every test. Schedules are short, code paths are the real ones."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from api_schemas.environments import Environment
from api_schemas.projects import LabelingPolicy, ProjectCreate
from models.families import GridFamily
from models.training import TrainingConfig
from service.settings import Settings
from tests.workers.in_process import Loop

STEPS = 20
ROOM = Environment(simulator="minigrid", options={"task": "any", "room_size": 6, "objects": 3})
FULL_SCHEDULE = GridFamily.training_config
OpenLoop = Callable[..., Loop]


def short_schedule(family: GridFamily, kind: str, segments: int) -> TrainingConfig:
    """The family's own schedule, but of STEPS small steps."""
    return replace(FULL_SCHEDULE(family, kind, segments), steps=STEPS, batch_size=16)


def open_loop(folder: Path, **settings: object) -> Loop:
    """A service and worker on `folder`, with a lease long enough for a busy machine."""
    values = {"data_folder": folder, "job_lease_seconds": 60.0, **settings}
    return Loop(Settings.model_validate(values))


def new_project(loop: Loop, **fields: object) -> None:
    """An empty project whose rounds start only when they are asked for."""
    values = {"name": loop.name, "environment": ROOM, "policy": LabelingPolicy(round_labels=0), **fields}
    loop.client.create_project(ProjectCreate.model_validate(values))


@pytest.fixture(autouse=True, scope="package")
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True, scope="package")
def _short_schedules() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GridFamily, "training_config", short_schedule)
        yield


@pytest.fixture(scope="package")
def labeled_folder(tmp_path_factory: pytest.TempPathFactory, _short_schedules: None) -> Path:
    """600 pool transitions of which 60 are labeled, 14 held-out labels, no round yet."""
    folder = tmp_path_factory.mktemp("labeled")
    loop = open_loop(folder)
    new_project(loop)
    loop.collect(600, behavior="mixture", seed=1, split="pool")
    loop.collect(3000, behavior="balanced", seed=2, split="held_out", per_action=2)
    loop.label(60, "random")
    loop.close()
    return folder


@pytest.fixture(scope="package")
def undisturbed(trained_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """By kind, the hash of the weights in `trained_folder`: what a run without any incident ends with."""
    folder = tmp_path_factory.mktemp("read") / "data"
    shutil.copytree(trained_folder, folder)
    loop = open_loop(folder)
    found: dict[str, str] = {model.kind: model.sha256 for model in loop.client.models(loop.project.id)}
    loop.close()
    return found


@pytest.fixture(scope="package")
def trained_folder(tmp_path_factory: pytest.TempPathFactory, labeled_folder: Path) -> Path:
    """The same with a current round by the default strategy and a subgoal generator."""
    folder = tmp_path_factory.mktemp("trained") / "data"
    shutil.copytree(labeled_folder, folder)
    loop = open_loop(folder)
    assert loop.train().status == "current"
    loop.close()
    return folder


@pytest.fixture
def opened(tmp_path: Path, migrated: Path) -> Iterator[OpenLoop]:
    """Opens a loop on a copy of a folder, or on a new one; closes all of them at the end."""
    loops: list[Loop] = []

    def copy(folder: Path | None = None, **settings: object) -> Loop:
        own = tmp_path / f"data-{len(loops)}"
        if folder is not None:
            shutil.copytree(folder, own)
        else:
            own.mkdir()
            shutil.copy(migrated, own / "asim.db")
        loops.append(open_loop(own, **settings))
        return loops[-1]

    yield copy
    for loop in loops:
        loop.close()


@pytest.fixture
def empty(opened: OpenLoop) -> Loop:
    """A project without anything."""
    loop = opened()
    new_project(loop)
    return loop


@pytest.fixture
def labeled(opened: OpenLoop, labeled_folder: Path) -> Loop:
    """A copy of `labeled_folder`."""
    return opened(labeled_folder)


@pytest.fixture
def trained(opened: OpenLoop, trained_folder: Path) -> Loop:
    """A copy of `trained_folder`."""
    return opened(trained_folder)
