"""What every test may ask for."""

import signal
from collections.abc import Iterator

import pytest
import structlog

from tests.figures import figures, pytest_runtest_call, pytest_terminal_summary

__all__ = ["figures", "pytest_configure", "pytest_runtest_call", "pytest_terminal_summary"]


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
