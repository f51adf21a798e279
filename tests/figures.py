"""Figures that slow tests measure: pytest prints them at its end, also where all pass; a missed target fails its test.

def test_something(figures: Figures) -> None:
    figures.none("lost labels", lost)
    figures.add("p95 of POST /acquire", 1e3 * p95, "ms", target=50, better="below")
    figures.note(f"ASIM_TEST_SEED={seed}")
"""

from collections.abc import Generator
from typing import Literal

import pytest

from benchmarks.figures import Figure

LINE = "figure"  # among the properties that a test's report carries, also from one process to another
MISSED: pytest.StashKey[list[str]] = pytest.StashKey()  # lines of one test


class Figures:
    """What one test tells."""

    def __init__(self, item: pytest.Item) -> None:
        self._item = item
        self._missed = item.stash.setdefault(MISSED, [])

    def add(
        self,
        name: str,
        value: float,
        unit: str,
        target: float | None = None,
        better: Literal["below", "above"] = "above",
    ) -> Figure:
        """Record a figure. Its target may be missed here; the test fails at its end."""
        figure = Figure(name, value, unit, target, better)
        self.note(figure.line())
        if not figure.met:
            self._missed.append(figure.line())
        return figure

    def none(self, name: str, found: int) -> Figure:
        """Record a count whose target is 0: losses, duplicates, overlaps."""
        return self.add(name, found, "found", target=1, better="below")

    def note(self, line: str) -> None:
        """Record a line that is no figure, such as the seed."""
        self._item.user_properties.append((LINE, line))


@pytest.fixture
def figures(request: pytest.FixtureRequest) -> Figures:
    """The test's figures."""
    return Figures(request.node)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    """A test that has passed otherwise fails by its missed targets."""
    yield
    missed = item.stash.get(MISSED, [])
    if missed:
        pytest.fail("\n".join(missed), pytrace=False)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """All figures, by test."""
    ended = [*terminalreporter.getreports("passed"), *terminalreporter.getreports("failed")]
    told = {report.nodeid: [line for name, line in report.user_properties if name == LINE] for report in ended}
    if any(told.values()):
        terminalreporter.section("figures")
    for test, lines in told.items():
        if lines:
            terminalreporter.line(test)
        for line in lines:
            terminalreporter.line(f"    {line}")
