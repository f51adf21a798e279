"""What every test may ask for."""

from tests.figures import figures, pytest_runtest_call, pytest_terminal_summary

__all__ = ["figures", "pytest_runtest_call", "pytest_terminal_summary"]
