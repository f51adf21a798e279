"""Services on fresh SQLite databases, and on a real PostgreSQL."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete

from service.settings import Settings
from service.store.columns import Row
from service.store.database import migrate
from tests.command import command
from tests.servers import shared_database
from tests.service.kit import MAX_BODY_BYTES, START, Served, serve

__all__ = ["command"]
Serve = Callable[..., Served]


@pytest.fixture(autouse=True)
def _no_settings_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("ASIM_") and not name.startswith("ASIM_TEST_")]:
        monkeypatch.delenv(name)


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty database of either kind, without a schema."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'fresh.db'}"
    return str(request.getfixturevalue("postgres_url"))


@pytest.fixture
def start(tmp_path: Path, migrated: Path) -> Iterator[Serve]:
    """Start a service on `tmp_path` with these settings; all are closed after the test."""
    started: list[Served] = []
    shutil.copy(migrated, tmp_path / "asim.db")

    def make(**settings: Any) -> Served:
        started.append(serve(Settings(**({"data_folder": tmp_path} | settings))))
        return started[-1]

    yield make
    for served in started:
        served.close()


@pytest.fixture(scope="session")
def _embedded(tmp_path_factory: pytest.TempPathFactory, migrated: Path) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("embedded")
    shutil.copy(migrated, folder / "asim.db")
    made = serve(Settings(data_folder=folder, max_body_bytes=MAX_BODY_BYTES))
    yield made
    made.close()


@pytest.fixture
def served(_embedded: Served) -> Iterator[Served]:
    """An empty service in embedded mode. One for all tests, emptied after each: a new one prepares every query anew."""
    _embedded.clock.now = START
    yield _embedded
    with _embedded.services.database.write() as session:
        for table in reversed(Row.metadata.sorted_tables):
            if table.name != "event_epoch":
                session.execute(delete(table))
    for path in [path for path in _embedded.settings.data_folder.glob("*/*") if path.is_dir()]:
        shutil.rmtree(path)


@pytest.fixture(scope="session")
def _postgres_schema(postgres_server: str) -> Iterator[str]:
    with shared_database(postgres_server) as url:
        migrate(url)
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def on_both(request: pytest.FixtureRequest) -> Served:
    """The same test on both databases."""
    served: Served = request.getfixturevalue("served" if request.param == "sqlite" else "on_postgres")
    return served


@pytest.fixture(scope="session")
def on_postgres(tmp_path_factory: pytest.TempPathFactory, _postgres_schema: str) -> Iterator[Served]:
    """A service on PostgreSQL, for all tests: each keeps to projects of its own."""
    made = serve(Settings(data_folder=tmp_path_factory.mktemp("postgres"), database_url=_postgres_schema))
    yield made
    made.close()
