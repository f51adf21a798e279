"""A prepared data folder, made once, and services on copies of it."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.loop.processes import Serving
from tests.workers.conftest import new_project, open_loop

LEASE_SECONDS = "3"
Serve = Callable[..., Serving]


@pytest.fixture(scope="session")
def prepared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with 2,400 pool transitions, 60 of them labeled, and 35 held-out labels; no round yet."""
    folder = tmp_path_factory.mktemp("prepared") / "data"
    loop = open_loop(folder)
    new_project(loop)
    loop.collect(2400, behavior="mixture", seed=1, split="pool")
    loop.collect(5000, behavior="balanced", seed=2, split="held_out", per_action=5)
    loop.label(60, "random")
    loop.close()
    return folder


@pytest.fixture
def serve(tmp_path: Path, prepared_folder: Path) -> Iterator[Serve]:
    """Starts `asim serve` on a copy of the prepared folder, with a job lease of 3 s; ends it after the test."""
    serving = Serving(tmp_path / "data", ASIM_JOB_LEASE_SECONDS=LEASE_SECONDS)

    def start() -> Serving:
        shutil.copytree(prepared_folder, serving.folder)
        serving.start()
        return serving

    yield start
    serving.close()
