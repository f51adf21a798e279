"""Rows in files and in another database are the rows that were there, and the service goes on with them."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
import zstandard
from sqlalchemy import func, make_url, select

from service.backup import MANIFEST, Manifest, TableFile, backup, read_manifest, restore
from service.settings import Settings
from service.store import transfer
from service.store.blobs import Blobs
from service.store.database import downgrade, migrate, newest_revision, open_database, revision_of
from service.store.errors import BackupExists, NoDatabase, NotEmpty, UnreadableBackup
from service.store.provenance import ProvenanceBlobs
from service.store.tables import EventEpochRow, EventRow, KeyRow, MembershipRow
from tests.command import Command
from tests.servers import shared_database
from tests.service.access_table import fill
from tests.service.kit import Clock, Served, answers, room, serve

APART = {"event_epoch"}  # says by how much this server's transactions are behind


def rows_of(url: str) -> dict[str, list[tuple[Any, ...]]]:
    with transfer.snapshot(url) as connection:
        return {
            name: [tuple(row) for row in connection.execute(select(table).order_by(*table.primary_key.columns))]
            for name, table in transfer.TABLES.items()
            if name not in APART
        }


@dataclass(frozen=True)
class Prepared:
    """What a service has left: its data folder, its database where that is no file in the folder, its time."""

    folder: Path
    database: str | None
    now: datetime


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def prepared(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, postgres_server: str
) -> Iterator[Prepared]:
    """One of everything, and things that JSON could spoil."""
    with ExitStack() as stack:
        url = ""
        if request.param == "postgresql":
            url = stack.enter_context(shared_database(postgres_server))
            migrate(url)
        settings = Settings(data_folder=tmp_path_factory.mktemp("prepared") / "source", database_url=url)
        with closing(serve(settings)) as served:
            things = fill(served, 'quotes " and \\ and é', 1)
            batch = served.acquire(things.project, 2, strategy="random")
            assert served.label(things.project, answers(batch), batch).status_code == 201
        yield Prepared(settings.data_folder, make_url(url).database if url else None, served.clock.now)


@pytest.fixture
def filled(prepared: Prepared, tmp_path: Path, postgres_server: str) -> Iterator[Served]:
    """A service on a copy of it, with a database of its own."""
    with ExitStack() as stack:
        url = stack.enter_context(shared_database(postgres_server, prepared.database)) if prepared.database else ""
        shutil.copytree(prepared.folder, tmp_path / "source")
        clock = Clock()
        clock.now = prepared.now
        yield stack.enter_context(closing(serve(Settings(data_folder=tmp_path / "source", database_url=url), clock)))


def stores(folder: Path) -> list[Blobs]:
    return [Blobs(str(folder / "blobs")), ProvenanceBlobs(str(folder / "provenance"))]


def own_stores(served: Served) -> list[Blobs]:
    held = served.services
    return [held.blobs, *([held.provenance] if held.provenance else [])]


def url_of(served: Served) -> str:
    return served.services.database.engine.url.render_as_string(hide_password=False)


def goes_on(url: str, folder: Path, served: Served) -> None:
    """Everything that was there answers, and what is new comes after it."""
    again = serve(Settings(data_folder=folder, database_url=url), served.clock)
    try:
        for project in served.get("/projects", limit=1000)["items"]:
            assert again.show(project["id"]) == project
        project = again.get("/projects", limit=1000)["items"][-1]["id"]
        again.upload(project, room(99, transitions=6))
        batch = again.acquire(project, 1, strategy="random")
        assert again.label(project, answers(batch), batch).status_code == 201
        newest = again.get("/events", newest=True, limit=1)["items"][0]
        assert newest["kind"] == "acquisition.labeled"
    finally:
        again.close()


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_a_copy_holds_the_same_rows_and_is_a_working_database(
    filled: Served, kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    target = f"sqlite:///{tmp_path / 'copy.db'}" if kind == "sqlite" else request.getfixturevalue("postgres_url")
    counts = transfer.copy(url_of(filled), target)
    assert counts["project"] >= 1
    assert rows_of(target) == rows_of(url_of(filled))
    for store in own_stores(filled):
        for blob in store.stored():
            next(each for each in stores(tmp_path) if blob.kind in each.kinds).put(
                blob.kind, store.get(blob.kind, blob.sha256)
            )
    goes_on(target, tmp_path, filled)
    with pytest.raises(NotEmpty, match="the database holds rows of "):
        transfer.copy(url_of(filled), target)


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_a_backup_restores_rows_and_blobs_into_a_database_of_either_kind(
    filled: Served, kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    before = rows_of(url_of(filled))
    made = backup(url_of(filled), own_stores(filled), tmp_path / "backup", filled.clock())
    assert (made.missing, made.tables["project"].rows) == ([], len(before["project"]))
    assert made.blobs["trajectories"] >= 1
    folder = tmp_path / "data"
    target = f"sqlite:///{folder / 'asim.db'}" if kind == "sqlite" else request.getfixturevalue("postgres_url")
    folder.mkdir()
    assert restore(tmp_path / "backup", target, stores(folder)) == made
    assert rows_of(target) == before
    goes_on(target, folder, filled)
    with pytest.raises(NotEmpty):
        restore(tmp_path / "backup", target, stores(folder))


def test_what_is_written_after_a_copy_comes_after_what_was_copied(filled: Served, postgres_url: str) -> None:
    """Another server may number its transactions from where this one has long been."""
    with filled.services.database.write() as session:
        session.execute(EventEpochRow.__table__.update().values(added=10**9))  # type: ignore[attr-defined]
        newest = session.scalar(select(func.max(EventRow.transaction)))
        session.add(EventRow(kind="far", data={}, created_at=filled.clock()))
    transfer.copy(url_of(filled), postgres_url)
    database = open_database(postgres_url)
    with database.write() as session:
        far = session.scalars(select(EventRow.transaction).where(EventRow.kind == "far")).one()
        assert far >= 10**9 > (newest or 0)
        session.add(EventRow(kind="next", data={}, created_at=filled.clock()))
        session.add(_member_like(session.scalars(select(MembershipRow).limit(1)).one()))
    with database.read() as session:
        assert session.scalars(select(EventRow.transaction).where(EventRow.kind == "next")).one() > far
        ids = session.scalars(select(MembershipRow.id)).all()
        assert len(ids) == len(set(ids)) == max(ids) or max(ids) > len(ids)
    database.close()


def _member_like(row: MembershipRow) -> EventRow:
    """Any new row that the database numbers."""
    return EventRow(project_id=row.project_id, kind="numbered", data={}, created_at=row.created_at)


def test_a_backup_is_refused_where_one_is(filled: Served, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BackupExists, match="is not empty"):
        backup(url_of(filled), own_stores(filled), tmp_path, filled.clock())


def test_a_damaged_backup_is_refused_before_any_row_is_written(filled: Served, tmp_path: Path) -> None:
    made = tmp_path / "backup"
    backup(url_of(filled), own_stores(filled), made, filled.clock())
    target = f"sqlite:///{tmp_path / 'target.db'}"
    migrate(target)

    def refusal(path: Path, content: bytes) -> str:
        whole = path.read_bytes()
        path.write_bytes(content)
        try:
            with pytest.raises(UnreadableBackup) as caught:
                restore(made, target, stores(tmp_path / "data"))
        finally:
            path.write_bytes(whole)
        return caught.value.detail

    labels = made / "tables" / f"label{transfer.SUFFIX}"
    assert "is not the file that the manifest tells of" in refusal(labels, labels.read_bytes()[:-3])
    blob = next(path for path in (made / "blobs").rglob("*") if path.is_file())
    assert "whole blobs, its manifest tells of" in refusal(blob, b"torn")
    manifest = made / MANIFEST
    assert f"has no readable {MANIFEST}" in refusal(manifest, b"{")
    told = json.loads(manifest.read_bytes())
    torn = zstandard.compress(b'["id", "no_such_column"]\n')
    labels.write_bytes(torn)
    told["tables"]["label"]["sha256"] = _sha256(torn)
    assert "no_such_column" in refusal(manifest, json.dumps(told).encode())
    assert all(rows == [] for rows in rows_of(target).values())
    assert read_manifest(made).tables["label"].rows > 0


def test_an_interrupted_backup_leaves_nothing_that_the_next_could_trip_over(
    filled: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(transfer, "dump", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            backup(url_of(filled), own_stores(filled), tmp_path / "backup", filled.clock())
    assert [path.name for path in tmp_path.iterdir()] == ["source"]
    made = backup(url_of(filled), own_stores(filled), tmp_path / "backup", filled.clock())
    assert (tmp_path / "backup").stat().st_mode & 0o077 == 0  # keys' hashes and tokens are in it
    assert restore(tmp_path / "backup", f"sqlite:///{tmp_path / 'target.db'}", stores(tmp_path / "data")) == made


def test_rows_of_an_older_schema_go_through_its_migrations_though_the_database_is_newer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, tables = f"sqlite:///{tmp_path / 'target.db'}", tmp_path / "backup" / "tables"
    tables.mkdir(parents=True)
    columns = ["id", "name", "secret_sha256", "scopes", "created_at"]  # 0009 brought two more
    row = [str(uuid4()), "ada", "0" * 64, ["read"], "2026-01-01T00:00:00+00:00"]
    rows = zstandard.compress(f"{json.dumps(columns)}\n{json.dumps(row)}\n".encode())
    (tables / f"api_key{transfer.SUFFIX}").write_bytes(rows)
    told = Manifest(
        version="0.1.0",
        revision="0008",
        created_at=datetime.now(UTC),
        tables={"api_key": TableFile(rows=1, sha256=_sha256(rows))},
        blobs={},
        missing=[],
    )
    (tmp_path / "backup" / MANIFEST).write_text(told.model_dump_json())
    migrate(target)
    passed: list[str] = []
    monkeypatch.setattr(transfer, "migrate", _noting(passed, migrate))
    monkeypatch.setattr(transfer, "downgrade", _noting(passed, downgrade))
    restore(tmp_path / "backup", target, [])
    assert passed == ["0008", "0008", "head"]
    with closing(open_database(target)) as database, database.read() as session:
        assert session.scalar(select(KeyRow.name)) == "ada"
        assert revision_of(session.connection()) == newest_revision()


def _noting(passed: list[str], real: Callable[..., None]) -> Callable[..., None]:
    def noted(url: str, revision: str = "head") -> None:
        passed.append(revision)
        real(url, revision)

    return noted


def test_rows_of_a_newer_version_are_refused(filled: Served, tmp_path: Path) -> None:
    backup(url_of(filled), own_stores(filled), tmp_path / "backup", filled.clock())
    manifest = tmp_path / "backup" / MANIFEST
    manifest.write_text(json.dumps(json.loads(manifest.read_bytes()) | {"revision": "9999"}))
    with pytest.raises(UnreadableBackup, match="9999 is a schema of a newer version"):
        restore(tmp_path / "backup", f"sqlite:///{tmp_path / 'target.db'}", stores(tmp_path / "data"))


def test_a_database_that_is_not_there_is_neither_copied_nor_made(tmp_path: Path) -> None:
    missing, old, target = (f"sqlite:///{tmp_path / name}.db" for name in ("missing", "old", "target"))
    migrate(old, "0008")
    for source, reason in ((missing, "is not there"), (old, "has schema 0008")):
        with pytest.raises(NoDatabase, match=reason):
            transfer.copy(source, target)
    assert [path.name for path in tmp_path.glob("*.db")] == ["old.db"]


def test_a_copy_is_its_makers_alone(filled: Served, tmp_path: Path) -> None:
    transfer.copy(url_of(filled), f"sqlite:///{tmp_path / 'copy.db'}")
    assert (tmp_path / "copy.db").stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("source", ["data/asim.db", "sqlit:///x.db", "postgresql+psycopg://127.0.0.1:1/x"])
def test_a_url_that_leads_nowhere_is_a_sentence(command: Command, tmp_path: Path, source: str) -> None:
    told = command("db", "copy", source, f"sqlite:///{tmp_path / 'copy.db'}", status=1)
    assert "the database" in told
    assert "Traceback" not in told


def test_a_blob_that_is_missing_is_named_and_the_rest_is_in_the_backup(filled: Served, tmp_path: Path) -> None:
    blobs = filled.services.blobs
    lost = next(blob for blob in blobs.stored() if blob.kind == "weights")
    data = blobs.get("weights", lost.sha256)
    blobs.delete("weights", lost.sha256)
    try:
        made = backup(url_of(filled), own_stores(filled), tmp_path / "backup", filled.clock())
    finally:
        blobs.put("weights", data)
    assert made.missing == [f"weights/{lost.sha256}"]
    assert made.blobs["trajectories"] >= 1


def _sha256(data: bytes) -> str:
    import hashlib

    return hashlib.sha256(data).hexdigest()
