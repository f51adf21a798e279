"""asim doctor on an installation that is well, and on ten that are not: what it says is wrong, and what to do."""

import shutil
import tempfile
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import text, update
from sqlalchemy.orm import Session

from asim import doctor
from asim.doctor import examine, report
from service import canary, jobs
from service.settings import Settings
from service.store.queries import jobs as job_queries
from service.store.tables import KeyRow, ProjectRow, WorkerRow
from tests.command import Command
from tests.private_servers import free_port
from tests.service.access_table import fill, holder
from tests.service.kit import Clock, Served, serve

HOUR = timedelta(hours=1)
Plant = Callable[[Served], None]


@pytest.fixture
def well(tmp_path: Path, migrated: Path) -> Iterator[Served]:
    """A service with one of everything, whose queues were served just now."""
    clock = Clock()
    clock.now = datetime.now(UTC)
    settings = Settings(data_folder=tmp_path / "data")
    settings.make_data_folder()
    shutil.copy(migrated, settings.data_folder / "asim.db")
    served = serve(settings, clock)
    fill(served, "rooms", 0)
    holder(served, "read")
    with served.services.database.write() as session:
        canary.plant(session, clock(), 60)
        jobs.worker_alive(session, "ada:1", canary.QUEUES, clock())
        _serve_queues(session, clock())
    yield served
    served.close()


def _serve_queues(session: Session, now: datetime) -> None:
    for row in job_queries.canaries(session):
        row.state, row.result, row.finished_at = "done", canary.done(now), now


def told(served: Served, later: timedelta = timedelta(), **settings: object) -> str:
    """All that is wrong, in words."""
    asked = served.settings.model_copy(update=settings)
    found = list(examine(asked, lambda: served.clock.now + later))
    return "\n".join(line for line in report(found) if not line.startswith("ok "))


def test_an_installation_that_is_well(command: Command, well: Served) -> None:
    printed = command("doctor", "--data", str(well.settings.data_folder))
    printed = "\n".join(line for line in printed.splitlines() if not line.startswith("event="))
    names = ["permissions", "disk", "broker", "database", "clock", "blobs", "queues", "simulators", "keys"]
    assert printed.split() == [word for name in names for word in ("ok", name)]


def test_a_fault_is_told_with_what_to_do_and_ends_with_status_1(
    command: Command, well: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = well.settings.data_folder
    monkeypatch.setenv("ASIM_MIN_FREE_BYTES", str(2**62))
    printed = command("doctor", "--quick", "--data", str(folder), status=1, stderr=False)
    assert f"FAULT  disk: {folder} has " in printed
    assert "       make room" in printed
    assert "ok     keys" in printed


def test_a_blob_in_the_trash_and_a_strangers_file_are_no_faults(well: Served) -> None:
    blobs = well.services.blobs
    for blob in list(blobs.stored()):
        blobs.discard(blob.kind, blob.sha256)
    (well.settings.data_folder / "blobs" / "weights" / "README").write_text("put here by somebody")
    assert told(well) == ""
    assert not list(blobs.stored())


def test_a_check_that_breaks_down_is_a_fault_and_the_others_go_on(
    well: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(doctor.THEN, "queues", lambda held: iter([1 / 0]))
    words = told(well, later=HOUR * 24 * 400)
    assert "FAULT  queues: the check broke down: ZeroDivisionError" in words


def test_the_time_that_another_check_takes_is_no_fault_of_the_clock(
    well: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A broker that does not answer takes seconds to say so, and workers go on meanwhile."""

    def slow(_: doctor.Installation) -> Iterator[doctor.Fault]:
        well.clock.now += timedelta(seconds=5)
        with well.services.database.write() as session:
            jobs.worker_alive(session, "ada:1", canary.QUEUES, well.clock.now)
        yield from ()

    monkeypatch.setitem(doctor.FIRST, "broker", slow)
    assert told(well) == ""


def test_a_folder_that_everybody_reaches_into(well: Served) -> None:
    """pytest's folders are this user's alone, so that nobody reaches into what lies below, whatever its mode."""
    well.settings.data_folder.chmod(0o755)
    assert "permissions" not in told(well)
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        said = told(well, blobs_url=folder)
    assert f"every user of this machine reaches into {folder} (mode 755)\n       chmod o= {folder}" in said


def test_a_new_data_folder_is_its_users_alone(tmp_path: Path) -> None:
    folder = Settings(data_folder=tmp_path / "new").make_data_folder()
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_database_of_another_version(well: Served) -> None:
    def at(revision: str) -> str:
        with well.services.database.write() as session:
            session.execute(text(f"UPDATE alembic_version SET version_num = '{revision}'"))
        return told(well)

    assert "has schema 0001, this version of asim needs 0" in at("0001")
    assert "run asim db upgrade" in at("0001")
    assert "install the version of asim that wrote it" in at("9999")


def test_a_missing_and_a_damaged_blob(well: Served) -> None:
    paths = {path.parents[1].name: path for path in (well.settings.data_folder / "blobs").rglob("*") if path.is_file()}
    paths["weights"].write_bytes(b"torn")
    paths["trajectories"].unlink()
    said = told(well)
    assert f"blob trajectories/{paths['trajectories'].name} is not in the store" in said
    assert f"{paths['weights'].name} should have the hash {paths['weights'].name}, its bytes have" in said
    assert said.count("copy it from a backup") == 2
    assert sorted(path.name for path in paths.values() if path.exists()) == sorted(
        path.name for kind, path in paths.items() if kind != "trajectories"
    )


def test_many_missing_blobs_are_counted(well: Served) -> None:
    for seed in range(2, 10):
        fill(well, f"rooms {seed}", seed)
    for path in (well.settings.data_folder / "blobs" / "trajectories").rglob("*"):
        if path.is_file():
            path.unlink()
    said = told(well)
    assert said.count("is not in the store") == 5
    assert "4 more blobs are missing or damaged" in said


def test_runners_that_are_gone(well: Served) -> None:
    assert "nobody serves this folder: no runner was heard of lately\n       start asim serve" in told(well, HOUR)
    with well.services.database.write() as session:
        jobs.worker_alive(session, "ada:2", ("score",), well.clock.now + HOUR)
    said = told(well, HOUR)
    assert "nothing was done in the queue train for 3600 s; 1 workers were heard of lately" in said
    assert "start asim worker --queues train" in said


def test_a_full_disk(well: Served) -> None:
    said = told(well, min_free_bytes=2**62)
    assert f"{well.settings.data_folder} has " in said
    assert "less than 4294967296.0 GiB" in said
    assert "asim gc" in said


def test_a_clock_that_is_wrong(well: Served) -> None:
    with well.services.database.write() as session:
        session.execute(update(WorkerRow).values(heartbeat_at=well.clock.now + HOUR))
    assert "the newest sign of a worker is 3600 s ahead of this machine's clock" in told(well)


def test_a_folder_that_is_gone(well: Served) -> None:
    shutil.rmtree(well.settings.data_folder / "provenance")
    assert "provenance is not there" in told(well)
    assert not (well.settings.data_folder / "provenance").exists()  # it looks and changes nothing


def test_a_broker_that_does_not_answer(well: Served) -> None:
    port = free_port()
    said = told(well, broker_url=f"redis://:secret@127.0.0.1:{port}/0", database_url=_url(well))
    assert f"the broker 127.0.0.1:{port}/0 does not answer" in said
    assert "secret" not in said


def test_a_database_that_does_not_answer(well: Served) -> None:
    said = told(well, database_url=f"postgresql+psycopg://asim:secret@127.0.0.1:{free_port()}/asim")
    assert "does not answer" in said
    assert "secret" not in said


def test_a_simulator_that_is_not_installed(well: Served) -> None:
    with well.services.database.write() as session:
        session.execute(update(ProjectRow).values(environment={"simulator": "mujoco_playground", "options": {}}))
    assert "project 'rooms' needs the simulator mujoco_playground, which is not installed here" in told(well)


def test_a_key_that_has_expired(well: Served) -> None:
    with well.services.database.write() as session:
        session.execute(update(KeyRow).where(KeyRow.name == "ada").values(expires_at=well.clock.now - HOUR))
        named = session.query(KeyRow.id).where(KeyRow.name == "ada").scalar()
    said = told(well)
    assert f"key {named} of 'ada' expired at" in said
    assert f"asim key revoke {named}" in said


def _url(served: Served) -> str:
    return served.services.database.engine.url.render_as_string(hide_password=False)
