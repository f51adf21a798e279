"""Migrations: what they build is what the tables say, on both databases; data outlives them, up, down and cut short."""

import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from uuid import UUID

import pytest
from sqlalchemy import Engine, select, text
from sqlalchemy.exc import DBAPIError

from service import projects
from service.settings import Settings
from service.store.columns import Row
from service.store.database import migrate, open_database
from service.store.tables import EventEpochRow, ProjectRow
from tests.service.first_schema import EMPTY, FIRST, NAMES, SECOND, fill, narrowed, read, write
from tests.service.kit import Served, serve
from tests.service.migrating import (
    check_references,
    differences,
    downgrade,
    engine_of,
    schema_of,
    tables,
    version,
)

COUNTERS = {
    FIRST: {"pool_trajectories": 2, "pool_segments": 12, "held_out_trajectories": 1, "held_out_segments": 4},
    SECOND: {"pool_trajectories": 1, "pool_segments": 9, "held_out_trajectories": 2, "held_out_segments": 5},
    EMPTY: {"pool_trajectories": 0, "pool_segments": 0, "held_out_trajectories": 0, "held_out_segments": 0},
}
HELD_OUT_LABELS = {FIRST: 1, SECOND: 2, EMPTY: 0}
MIGRATE = "import sys; from service.store.database import migrate; migrate(sys.argv[1])"
KILLED = f"""
import os, signal
from alembic import op
op.batch_alter_table = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)  # columns are there, not all are filled
{MIGRATE}
"""


def _process(code: str, url: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", code, url], stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def _ended(process: subprocess.Popen[bytes]) -> int:
    try:
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode in (0, -9), errors.decode()
    return process.returncode


def test_a_new_file_that_another_is_writing_is_waited_for(tmp_path: Path) -> None:
    """SQLite answers at once that it is locked, whatever its timeout: a log written ahead needs the file alone."""
    file = tmp_path / "new.sqlite"
    other = sqlite3.connect(file, isolation_level=None, check_same_thread=False)
    other.execute("CREATE TABLE begun (id INTEGER)")
    other.execute("BEGIN IMMEDIATE")
    end = threading.Timer(0.5, other.execute, ("COMMIT",))
    end.start()
    database = open_database(f"sqlite:///{file}")
    began = time.monotonic()
    with database.read() as session:
        assert session.scalar(text("PRAGMA journal_mode")) == "wal"
    assert time.monotonic() - began > 0.3
    end.join()
    database.close()
    other.close()


def test_up_down_and_up_again_is_what_the_tables_say(url: str) -> None:
    migrate(url)
    assert differences(url) == []
    assert tables(url) == {*Row.metadata.tables, "alembic_version"}
    migrate(url)  # the newest already
    downgrade(url, "base")
    assert tables(url) == {"alembic_version"}
    migrate(url)
    assert differences(url) == []


def test_the_first_schema_is_upgraded_with_its_data_and_counted(url: str) -> None:
    migrate(url, "0001")
    before = fill(url)
    migrate(url)
    assert differences(url) == []
    after = read(url)
    assert narrowed(after, before) == before
    for row in after["project"]:
        counted = {name: row[name] for name in next(iter(COUNTERS.values()))}
        assert counted == COUNTERS[UUID(hex=row["id"])]
        assert row["held_out_labels"] == HELD_OUT_LABELS[UUID(hex=row["id"])]
    assert {row["mode"] for row in after["acquisition"]} == {"pool"}
    assert {(row["actor"], row["correlation"], row["transaction"]) for row in after["event"]} == {("", "", 0)}
    assert {(row["correlation"], row["checkpoint_stage"]) for row in after["job"]} == {("", None)}
    assert {row["diagnostics"] for row in after["round"]} == {None}
    assert after["idempotency"] == []
    assert _rules(url) == {FIRST: "kmeans_plus_plus", SECOND: "top", EMPTY: "top"}
    check_references(url)


def test_the_tables_read_every_row_of_an_upgraded_database(url: str) -> None:
    migrate(url, "0001")
    before = fill(url)
    migrate(url)
    database = open_database(url)
    with database.read() as session:
        for mapper in Row.registry.mappers:
            found = session.scalars(select(mapper.class_)).all()
            there = 1 if mapper.class_ is EventEpochRow else len(before.get(mapper.class_.__tablename__, []))
            assert len(found) == there, mapper
    database.close()


def test_an_upgraded_service_goes_on_where_it_was(url: str, tmp_path: Path) -> None:
    migrate(url, "0001")
    fill(url)
    migrate(url)
    served = serve(Settings(data_folder=tmp_path, database_url=url))
    try:
        _check_service(served)
    finally:
        served.close()


def _check_service(served: Served) -> None:
    first, second = served.show(str(FIRST)), served.show(str(SECOND))
    assert first["counts"] == {
        "pool_trajectories": 2,
        "pool_segments": 12,
        "unlabeled": 9,
        "leased": 1,
        "labeled": 2,
        "held_out_trajectories": 1,
        "held_out_segments": 4,
        "held_out_labeled": 1,
    }
    assert first["budget"] == {"total": 10, "spent": 2, "reserved": 1, "remaining": 7}
    assert (second["counts"]["held_out_labeled"], second["label_watermark"]) == (2, 3)
    assert [row["actor"] for row in served.events(str(FIRST))] == ["", ""]
    held_out = {"trajectory": NAMES[2], "start": 0, "actions": [0]}
    assert served.label(str(FIRST), [held_out]).json()["watermark"] == 4
    assert served.show(str(FIRST))["counts"]["held_out_labeled"] == 2
    taken = {"trajectory": NAMES[1], "start": 1, "actions": [0]}
    assert served.label(str(FIRST), [taken]).status_code == 423
    lease = {"id": str(UUID(int=FIRST.int + 1)), "token": 1}
    assert served.label(str(FIRST), [taken], lease).json()["created"] == 1
    assert served.get(f"/acquisitions/{lease['id']}")["status"] == "labeled"


def _rules(url: str) -> dict[UUID, str]:
    """What became of policies that said whether batches are diverse."""
    database = open_database(url)
    with database.read() as session:
        found = {row.id: projects.policy_of(row).batch_rule for row in session.scalars(select(ProjectRow))}
    database.close()
    return dict(found)


def test_going_back_keeps_all_that_the_first_schema_knows(url: str) -> None:
    migrate(url, "0001")
    before, schema = fill(url), schema_of(url)
    migrate(url)
    downgrade(url, "0001")
    assert (version(url), schema_of(url), read(url)) == ("0001", schema, before)
    check_references(url)
    migrate(url)
    assert narrowed(read(url), before) == before


def test_going_back_says_what_is_new_in_the_first_schemas_words(url: str) -> None:
    migrate(url, "0001")
    before = fill(url)
    migrate(url)
    job, rounded, leased, labeled = (UUID(int=FIRST.int + more) for more in (6, 3, 1, 2))
    quoted = [str(each) if "postgresql" in url else each.hex for each in (job, rounded, leased, labeled)]
    write(
        url,
        f"UPDATE job SET state = 'cancelled' WHERE id = '{quoted[0]}'",
        f"UPDATE round SET status = 'cancelled' WHERE id = '{quoted[1]}'",
        f"UPDATE acquisition SET status = 'expired' WHERE id = '{quoted[2]}'",
        f"UPDATE acquisition SET mode = 'explore' WHERE id = '{quoted[3]}'",
        f"UPDATE acquisition_item SET actions = '[1]' WHERE acquisition_id = '{quoted[3]}'",
        "UPDATE job SET project_id = NULL, kind = 'canary' WHERE state = 'queued'",
        "INSERT INTO idempotency (caller, route, key, request_sha256, expires_at) "
        "VALUES ('local', 'POST /labels', 'k', 'x', '2030-01-01 00:00:00')",
    )
    downgrade(url, "0001")
    after = read(url)
    states = {row["id"]: row["state"] for row in after["job"]}
    assert states.pop(job.hex) == "failed"
    assert set(states.values()) == {"done"}  # the other one that waited is a canary by now
    assert {row["id"]: row["status"] for row in after["round"]}[rounded.hex] == "failed"
    statuses = {row["id"]: row["status"] for row in after["acquisition"]}
    assert statuses[leased.hex] == "leased"
    assert labeled.hex not in statuses
    assert labeled.hex not in {row["acquisition_id"] for row in after["acquisition_item"]}
    assert after["label"] == before["label"]  # also those that the forgotten acquisition brought
    check_references(url)
    migrate(url)
    assert differences(url) == []


def test_a_migration_that_fails_in_the_middle_changes_nothing(url: str) -> None:
    migrate(url, "0001")
    write(url, "ALTER TABLE job ADD COLUMN checkpoint_stage VARCHAR(60)")  # the last column that the migration adds
    before, schema = fill(url), schema_of(url)
    with pytest.raises(DBAPIError, match="checkpoint_stage"):
        migrate(url)
    assert (version(url), schema_of(url), read(url)) == ("0001", schema, before)
    write(url, "ALTER TABLE job DROP COLUMN checkpoint_stage")
    migrate(url)
    assert differences(url) == []


def test_a_migration_that_is_killed_in_the_middle_changes_nothing(url: str) -> None:
    migrate(url, "0001")
    before, schema = fill(url), schema_of(url)
    assert _ended(_process(KILLED, url)) == -9
    assert (version(url), schema_of(url), read(url)) == ("0001", schema, before)
    migrate(url)
    assert differences(url) == []
    assert narrowed(read(url), before) == before


def test_processes_that_migrate_at_once_take_turns(postgres_url: str) -> None:
    migrate(postgres_url, "0001")
    before = fill(postgres_url)
    engine = engine_of(postgres_url)
    with engine.begin() as connection:
        connection.execute(text("LOCK TABLE job IN ACCESS SHARE MODE"))  # holds the first one in the middle
        processes = [_process(MIGRATE, postgres_url) for _ in range(2)]
        _until(lambda: _waiting(engine) == 2)
        assert {process.poll() for process in processes} == {None}
    assert [_ended(process) for process in processes] == [0, 0]
    assert differences(postgres_url) == []
    assert narrowed(read(postgres_url), before) == before


def test_processes_that_make_an_empty_database_at_once_take_turns(url: str) -> None:
    processes = [_process(MIGRATE, url) for _ in range(2)]
    assert [_ended(process) for process in processes] == [0, 0]
    assert differences(url) == []


def _waiting(engine: Engine) -> int:
    """Sessions of this database that wait for a lock."""
    query = "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND wait_event_type = 'Lock'"
    with engine.connect() as connection:
        return connection.scalar(text(query)) or 0


def _until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.02)
