"""The command line in the test's process."""

import sys
from typing import Protocol

import pytest

from asim.cli import main


class Command(Protocol):
    """The command line in this process."""

    def __call__(self, *arguments: str, status: int = 0, stderr: bool | None = None) -> str: ...


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs one command; returns what it printed, on stderr where it has to fail, unless the other is asked for."""

    def run(*arguments: str, status: int = 0, stderr: bool | None = None) -> str:
        monkeypatch.setattr(sys, "argv", ["asim", *arguments])
        with pytest.raises(SystemExit) as end:
            main()
        printed, complained = capsys.readouterr()
        assert (end.value.code or 0) == status, printed + complained
        return complained if (bool(status) if stderr is None else stderr) else printed

    return run
