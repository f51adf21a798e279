"""What every test may ask for."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog

from service.store.database import migrate
from tests.figures import figures, pytest_runtest_call, pytest_terminal_summary
from tests.servers import postgres_server, postgres_url, redis_server, redis_space

__all__ = [
    "figures",
    "postgres_server",
    "postgres_url",
    "pytest_collection_modifyitems",
    "pytest_configure",
    "pytest_runtest_call",
    "pytest_terminal_summary",
    "redis_server",
    "redis_space",
]
LONGEST = ("loop", "compose", "hostile", "face", "pages", "workers", "simulators")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Folders whose files take longest come first: at the end no process is left alone with one that takes a minute."""
    items.sort(key=lambda item: _place(item.path.parent.name))


def _place(folder: str) -> int:
    return LONGEST.index(folder) if folder in LONGEST else len(LONGEST)


def pytest_configure() -> None:
    """A shell has its background jobs ignore Ctrl-C, and what they start inherits that: the tests mean to send it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def _short_logs() -> Iterator[None]:
    """A failed job's traceback with all its local variables takes seconds to print. For all tests, whichever come first
    in a process: a service that finds logs configured leaves them so, and one that does not keeps its loggers for good,
    past any test that listens to them.
    """
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
