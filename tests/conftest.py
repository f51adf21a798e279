"""What every test may ask for."""

import signal

from tests.figures import figures, pytest_runtest_call, pytest_terminal_summary

__all__ = ["figures", "pytest_configure", "pytest_runtest_call", "pytest_terminal_summary"]


def pytest_configure() -> None:
    """A shell has its background jobs ignore Ctrl-C, and what they start inherits that: the tests mean to send it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
