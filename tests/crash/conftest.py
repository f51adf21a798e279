"""Prepared projects as a database to copy, and deployments on copies of it."""

import os
import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from sqlalchemy import make_url

from api_schemas.keys import KeyCreate
from models.families import GridFamily
from service import keys
from service.clock import utc_now
from tests.crash.deployment import Deployment
from tests.figures import Figures
from tests.loop.rows import Segment
from tests.private_servers import PrivatePostgres, PrivateRedis
from tests.servers import postgres_database
from tests.workers.conftest import new_project, open_loop, short_schedule

REPEAT = int(os.environ.get("REPEAT", "50"))
ROOMS = ("room 0", "room 1", "room 2", "busy")
Deploy = Callable[..., Deployment]


@dataclass(frozen=True)
class Prepared:
    """Equal projects, each with a current round of tiny networks: data folder, template database, key, labels."""

    folder: Path
    template: str
    key: str
    labeled: dict[str, list[Segment]]


@pytest.fixture(scope="session")
def postgres() -> Iterator[PrivatePostgres]:
    """A PostgreSQL server of these tests' own."""
    with PrivatePostgres() as server:
        yield server


@pytest.fixture(scope="session")
def prepared(postgres: PrivatePostgres, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Prepared]:
    """ROOMS: 1,200 pool transitions of which 60 are labeled, 14 held-out labels, round 1, a subgoal generator.

    They have one seed and one content, so that their next rounds train the same networks.
    """
    folder, threads = tmp_path_factory.mktemp("prepared") / "data", torch.get_num_threads()
    torch.set_num_threads(1)
    with postgres_database(postgres.url) as url, pytest.MonkeyPatch.context() as patch:
        patch.setattr(GridFamily, "training_config", short_schedule)
        loop = open_loop(folder, database_url=url, queue_length=1200)
        labeled = {}
        for name in ROOMS:
            loop.name = name
            new_project(loop)
            loop.collect(1200, behavior="mixture", seed=1, split="pool")
            loop.collect(3000, behavior="balanced", seed=2, split="held_out", per_action=2)
            loop.label(60, "random")
            assert loop.train().status == "current"
            labeled[name] = [(label.trajectory, label.start) for label in loop.client.labels(loop.project.id)]
        with loop.worker.database.write() as session:
            key = keys.create(session, KeyCreate(name="test", scopes=["admin"]), utc_now()).secret
        loop.close()
        torch.set_num_threads(threads)
        yield Prepared(folder, str(make_url(url).database), key, labeled)


@pytest.fixture
def redis() -> Iterator[PrivateRedis]:
    """A Redis server of the test's own, which keeps its data over a kill."""
    with PrivateRedis(append_only=True) as server:
        yield server


@pytest.fixture
def deploy(postgres: PrivatePostgres, prepared: Prepared, redis: PrivateRedis, tmp_path: Path) -> Iterator[Deploy]:
    """Starts an API and `workers` workers on a copy of the prepared projects; kills all of it at the end."""
    with ExitStack() as stack:

        def start(workers: int = 0, **settings: str) -> Deployment:
            url = stack.enter_context(postgres_database(postgres.url, prepared.template))
            folder = tmp_path / "data"
            shutil.copytree(prepared.folder, folder)
            deployment = Deployment(folder, url, redis, prepared.key, **settings)
            stack.callback(deployment.close)
            deployment.start_api()
            for _ in range(workers):
                deployment.start_worker()
            return deployment

        yield start


@pytest.fixture
def chance(figures: Figures) -> random.Random:
    """Random moments. ASIM_TEST_SEED repeats those of another run."""
    seed = int(os.environ.get("ASIM_TEST_SEED") or random.SystemRandom().randrange(10**6))
    figures.note(f"ASIM_TEST_SEED={seed}")
    return random.Random(seed)
