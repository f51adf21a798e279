"""Runs of a benchmark: done once, in their own processes, and a file only of what has ended."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.paper import runs
from benchmarks.paper.runs import (
    EXPLORING,
    Json,
    code_digest,
    do,
    read,
    result_file,
    results,
    run_missing,
    sources_digest,
)


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


def test_results_of_other_code_are_not_told_and_made_again(
    tmp_path: Path, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, run = tmp_path / "out", Count(1, log)
    run_missing([run], out, 1, 1)
    file = result_file(out, run)
    told = json.loads(file.read_text())
    assert told["code"] == code_digest()
    file.write_text(json.dumps(told | {"code": "other", "doubled": -1}))
    assert results([run], out) == []
    run_missing([run], out, 1, 1)
    assert f"1 results in {out} are of other code" in capsys.readouterr().out
    assert [each["doubled"] for each in results([run], out)] == [2]


def test_the_codes_digest_turns_on_what_results_depend_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "ROOT", tmp_path)
    digests = list[str]()
    for file in ("models/a.py", "models/a.py", "benchmarks/paper/b_table.py", "workers/app.py", "workers/data.py"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(f"x = {len(digests)}")
        digests.append(sources_digest.__wrapped__(*runs.CODE))
    assert digests[0] != digests[1] == digests[2] == digests[3] != digests[4]


def test_results_depend_on_explore_mode_where_they_say_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else an arm of pool mode would be run again for every change to it."""
    monkeypatch.setattr(runs, "ROOT", tmp_path)
    monkeypatch.setattr(runs, "code_digest", lambda *also: sources_digest.__wrapped__(*runs.CODE, *also))
    source = tmp_path / runs.EXPLORING[0]
    source.parent.mkdir()
    source.write_text("x = 0")
    for number, also in enumerate(((), runs.EXPLORING)):
        told = {"code": runs.code_digest(*also), "also": also}
        (tmp_path / f"count{number}.json").write_text(json.dumps(told))
    source.write_text("x = 1")
    assert [read(tmp_path / f"count{number}.json") is None for number in (0, 1)] == [False, True]


def test_a_run_that_fails_is_told_and_leaves_no_file(tmp_path: Path, log: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(ArithmeticError, match="got -2"):
        run_missing([Count(1, log), Count(-2, log)], out, 1, 1)
    assert [path.name for path in out.iterdir()] == ["count1.json"]


def test_code_that_changes_under_a_benchmark_ends_it(tmp_path: Path, log: Path) -> None:
    """Else results of either code would bear the digest of the later."""
    with pytest.raises(RuntimeError, match="The code has changed since the benchmark began"):
        do(Count(1, log), tmp_path, "earlier")
    assert not log.exists()
    assert do(Count(1, log), tmp_path, code_digest(*EXPLORING))[0] == "count1"
