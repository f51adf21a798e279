"""Telling how far work has come: bars on a terminal, plain lines elsewhere."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

Advance = Callable[[float, str], None]  # (share done from 0 to 1, what is going on)
PLAIN_SECONDS = 15.0  # between two plain lines of the same step
PLAIN_WIDTH = 200


class Report:
    """Use as a context manager; steps may run in several threads at once."""

    def __init__(self, console: Console | None = None) -> None:
        console = console or Console()
        # Rich assumes 80 columns where there is no terminal, which breaks the lines of a log.
        self.console = console if console.is_terminal else Console(file=console.file, width=PLAIN_WIDTH)
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        self._bars = Progress(*columns, TextColumn("{task.fields[message]}"), console=self.console)

    def __enter__(self) -> Self:
        if self.console.is_terminal:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.console.is_terminal:
            self._bars.stop()

    def tell(self, line: str) -> None:
        """One line, above any bars."""
        self.console.print(line, highlight=False, markup=False, soft_wrap=True)

    @contextmanager
    def step(self, description: str) -> Iterator[Advance]:
        """A piece of work; what is yielded tells how far it is."""
        began = time.monotonic()
        with self._bar(description) if self.console.is_terminal else self._lines(description) as advance:
            yield advance
        self.tell(f"{description}: done in {time.monotonic() - began:.1f} s")

    @contextmanager
    def _bar(self, description: str) -> Iterator[Advance]:
        task = self._bars.add_task(description, total=1.0, message="")
        try:
            yield lambda share, message: self._bars.update(task, completed=share, message=message)
        finally:
            self._bars.remove_task(task)

    @contextmanager
    def _lines(self, description: str) -> Iterator[Advance]:
        last = time.monotonic()

        def advance(share: float, message: str) -> None:
            nonlocal last
            if time.monotonic() - last >= PLAIN_SECONDS:
                last = time.monotonic()
                self.tell(f"{description}: {share:.0%} {message}".rstrip())

        yield advance
