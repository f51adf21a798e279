"""A service of its own for the tests of the face, and the command line in this process."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import pytest

from asim.cli import main
from asim.served import served


class Command(Protocol):
    """The command line in this process."""

    def __call__(self, *arguments: str, status: int = 0, stderr: bool = False) -> str: ...


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs one command; returns what it printed, on stderr where it has to fail or that is asked for."""

    def run(*arguments: str, status: int = 0, stderr: bool = False) -> str:
        monkeypatch.setattr(sys, "argv", ["asim", *arguments])
        with pytest.raises(SystemExit) as end:
            main()
        printed, complained = capsys.readouterr()
        assert (end.value.code or 0) == status, printed + complained
        return complained if status or stderr else printed

    return run


@pytest.fixture(scope="session")
def served_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data folder of `url`."""
    return tmp_path_factory.mktemp("serve")


@pytest.fixture(scope="session")
def url(served_folder: Path) -> Iterator[str]:
    """The URL of a running `asim serve`."""
    with served(served_folder) as listening:
        yield listening
