"""Runs of a benchmark: done once, in their own processes, and a file only of what has ended."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.paper.runs import Json, result_file, results, run_missing


@dataclass(frozen=True)
class Count:
    """Leaves a line in a log each time that it is done. Fails where its number is negative."""

    number: int
    log: Path

    @property
    def name(self) -> str:
        """Of its file."""
        return f"count{self.number}"

    def results(self) -> Json:
        """The number doubled."""
        with self.log.open("a") as log:
            print(self.number, file=log)
        if self.number < 0:
            raise ArithmeticError(f"number must not be negative, got {self.number}.")
        return {"doubled": 2 * self.number}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Of what was done."""
    return tmp_path / "log"


def test_a_finished_run_is_not_repeated_and_a_missing_one_is_done(tmp_path: Path, log: Path) -> None:
    out = tmp_path / "out"
    one, two, never = (Count(number, log) for number in (1, 2, 3))
    run_missing([one, two], out, 1, 1)
    result_file(out, one).unlink()
    run_missing([one, two], out, 1, 1)
    run_missing([one, two], out, 1, 1)
    assert log.read_text().split() == ["1", "2", "1"]
    assert [each["doubled"] for each in results([two, never, one], out)] == [4, 2]


def test_a_run_that_fails_is_told_and_leaves_no_file(tmp_path: Path, log: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(ArithmeticError, match="got -2"):
        run_missing([Count(1, log), Count(-2, log)], out, 1, 1)
    assert [path.name for path in out.iterdir()] == ["count1.json"]
