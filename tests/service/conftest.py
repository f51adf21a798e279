"""Services on fresh SQLite databases, and on a real PostgreSQL."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import structlog

from service.settings import Settings
from service.store.database import migrate
from tests.servers import postgres_database, postgres_server, postgres_url, redis_server, redis_space
from tests.service.kit import Served, serve

__all__ = ["postgres_server", "postgres_url", "redis_server", "redis_space"]
Serve = Callable[..., Served]


@pytest.fixture(autouse=True)
def _no_settings_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("ASIM_") and not name.startswith("ASIM_TEST_")]:
        monkeypatch.delenv(name)


@pytest.fixture(autouse=True, scope="session")
def _short_logs() -> Iterator[None]:
    """A failed job's traceback with all its local variables takes seconds to print."""
    structlog.configure(
        processors=[structlog.processors.format_exc_info, structlog.processors.KeyValueRenderer(key_order=["event"])]
    )
    yield
    structlog.reset_defaults()


@pytest.fixture(scope="session")
def migrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty database of the newest schema; a copy of it is quicker than its migrations."""
    path = tmp_path_factory.mktemp("migrated") / "asim.db"
    migrate(f"sqlite:///{path}")
    return path


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


@pytest.fixture
def served(start: Serve) -> Served:
    """A service in embedded mode."""
    return start()


@pytest.fixture(scope="session")
def _postgres_schema(postgres_server: str) -> Iterator[str]:
    with postgres_database(postgres_server) as url:
        migrate(url)
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def on_both(request: pytest.FixtureRequest, start: Serve) -> Served:
    """The same test on both databases; on PostgreSQL the tests share one, each in projects of its own."""
    if request.param == "sqlite":
        return start()
    return start(database_url=request.getfixturevalue("_postgres_schema"))


@pytest.fixture
def on_postgres(start: Serve, _postgres_schema: str) -> Served:
    """For what only a database with concurrent writers can get wrong."""
    return start(database_url=_postgres_schema)
