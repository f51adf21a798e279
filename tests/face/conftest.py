"""A service of its own for the tests of the face."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from asim.served import served
from tests.command import command

__all__ = ["command"]


@pytest.fixture(scope="session")
def served_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data folder of `url`."""
    return tmp_path_factory.mktemp("serve")


@pytest.fixture(scope="session")
def url(served_folder: Path) -> Iterator[str]:
    """The URL of a running `asim serve`."""
    with served(served_folder) as listening:
        yield listening
