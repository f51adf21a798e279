"""A backup taken while a round trains and somebody labels is a service that goes on from that moment."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from asim.client import Client
from service.store.transfer import copy
from tests.loop.conftest import LEASE_SECONDS, Serve
from tests.loop.invariants import check_invariants
from tests.loop.labelers import PersistentLabeler
from tests.loop.processes import Serving, environment, eventually

ROUND_SECONDS = 150.0


def asim(folder: Path, *arguments: str) -> str:
    """A command on that data folder; what it printed."""
    argv = [sys.executable, "-m", "asim", *arguments]
    done = subprocess.run(
        argv, env=environment(ASIM_DATA_FOLDER=str(folder)), capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def restored(tmp_path: Path) -> Iterator[Serving]:
    """A service that is started on the restored folder; ended after the test."""
    serving = Serving(tmp_path / "restored", ASIM_JOB_LEASE_SECONDS=LEASE_SECONDS)
    yield serving
    serving.close()


def test_a_backup_under_load_restores_to_a_service_that_goes_on(
    serve: Serve, restored: Serving, tmp_path: Path
) -> None:
    acknowledged, served = backed_up_under_load(serve(), tmp_path / "backup")
    printed = asim(restored.folder, "restore", str(tmp_path / "backup"))
    assert "rows and " in printed
    goes_on(restored, acknowledged, served)


@pytest.mark.slow
def test_the_restored_rows_go_to_postgresql_and_the_service_goes_on_there(
    serve: Serve, restored: Serving, tmp_path: Path, postgres_url: str
) -> None:
    acknowledged, served = backed_up_under_load(serve(), tmp_path / "backup")
    asim(restored.folder, "restore", str(tmp_path / "backup"))
    copy(f"sqlite:///{restored.folder / 'asim.db'}", postgres_url)
    restored.environment["ASIM_DATABASE_URL"] = postgres_url
    goes_on(restored, acknowledged, served, postgres_url)


def backed_up_under_load(serving: Serving, backup: Path) -> tuple[list[tuple[str, int]], str]:
    """The labels that were acknowledged before it began, and the round that was under way."""
    with Client(serving.url) as client:
        (project,) = client.projects()
        labeler = PersistentLabeler(serving.url, count=2, pause=0.2)
        labeler.start()
        asked = client.start_round(project.id)
        eventually(lambda: len(client.round(asked.id).stages) == 1, ROUND_SECONDS, "no stage is done")
        eventually(lambda: len(labeler.acknowledged) >= 4, 60, "nothing is labeled")
        acknowledged = list(labeler.acknowledged)
        printed = asim(serving.folder, "backup", str(backup))
        assert "blobs, schema" in printed
        assert client.round(asked.id).status in ("training", "scoring", "current")
        labeler.finish()
        assert len(labeler.acknowledged) > len(acknowledged)
    serving.close()
    return acknowledged, str(asked.id)


def goes_on(
    restored: Serving, acknowledged: list[tuple[str, int]], round_id: str, database_url: str | None = None
) -> None:
    """The round ends, labels come in, and all invariants hold."""
    restored.start()
    with Client(restored.url) as client:
        assert client.wait_for_round(round_id, timeout=ROUND_SECONDS).status in ("current", "superseded")
        labeler = PersistentLabeler(restored.url, count=2, pause=0.2, seed=1)
        labeler.start()
        eventually(lambda: len(labeler.acknowledged) >= 4, 60, "nothing is labeled")
        labeler.finish()
        (project,) = client.projects()

        def rests() -> bool:
            kinds = [job.kind for job in client.jobs(project.id) if job.state in ("queued", "running")]
            return kinds in ([], ["train_subgoal_generator"])

        eventually(rests, ROUND_SECONDS, "there are still open jobs")
        check_invariants(client, restored.folder, acknowledged + labeler.acknowledged, database_url=database_url)
