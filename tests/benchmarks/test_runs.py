"""Runs of a benchmark: done once, in their own processes, and a file only of what has ended."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.paper import runs
from benchmarks.paper.runs import (
    ALL_CODE,
    EXPLORATION_CODE,
    ROBOT_CODE,
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


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A root of other sources, whose digests nobody remembers."""
    monkeypatch.setattr(runs, "ROOT", tmp_path / "sources")
    (tmp_path / "sources" / "models").mkdir(parents=True)
    _forget_digests()
    yield tmp_path / "sources"
    _forget_digests()


def _forget_digests() -> None:
    runs._digests.cache_clear()
    sources_digest.cache_clear()


def test_the_codes_digest_turns_on_what_results_depend_on(sources: Path) -> None:
    digests = list[str]()
    for file in ("models/a.py", "models/a.py", "benchmarks/paper/b_table.py", "workers/app.py", "workers/data.py"):
        (sources / file).parent.mkdir(parents=True, exist_ok=True)
        (sources / file).write_text(f"x = {len(digests)}")
        _forget_digests()
        digests.append(code_digest())
    assert digests[0] != digests[1] == digests[2] == digests[3] != digests[4]


@pytest.mark.parametrize("file", EXPLORATION_CODE)
def test_results_depend_on_explore_mode_where_they_say_so(sources: Path, file: str) -> None:
    """Else an arm of pool mode would be run again for every change to it."""
    assert (Path(__file__).parents[2] / file).exists()
    for number, also in enumerate(((), EXPLORATION_CODE)):
        (sources / f"{number}.json").write_text(json.dumps({"code": code_digest(*also), "also": also}))
    (sources / "2.json").write_text(json.dumps({"also": ["other.py"]}))
    (sources / file).parent.mkdir(parents=True, exist_ok=True)
    (sources / file).write_text("x = 1")
    _forget_digests()
    assert [read(sources / f"{number}.json") is None for number in range(3)] == [False, True, True]


def test_results_on_minigrid_do_not_depend_on_the_robots_code(sources: Path) -> None:
    for number, also in enumerate(((), ROBOT_CODE)):
        (sources / f"{number}.json").write_text(json.dumps({"code": code_digest(*also), "also": also}))
    file = sources / "benchmarks" / "paper" / "robots" / "a.py"
    file.parent.mkdir(parents=True)
    file.write_text("x = 1")
    _forget_digests()
    assert [read(sources / f"{number}.json") is None for number in range(2)] == [False, True]
    assert sources_digest("benchmarks/paper/robots/a.py") != sources_digest("benchmarks/paper/robots/b.py")


@dataclass(frozen=True)
class Edit:
    """Somebody edits the source meanwhile."""

    source: Path
    name: str = "edit"

    def results(self) -> Json:
        """None."""
        self.source.write_text("x = 2")
        return {}


def test_results_bear_the_digest_of_the_code_that_their_run_began_with(sources: Path) -> None:
    (sources / "models" / "a.py").write_text("x = 1")
    began = sources_digest.__wrapped__(*runs.CODE)
    do(Edit(sources / "models" / "a.py"), sources, code_digest(*ALL_CODE))
    assert json.loads((sources / "edit.json").read_text())["code"] == began
    _forget_digests()
    assert read(sources / "edit.json") is None


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
    assert do(Count(1, log), tmp_path, code_digest(*ALL_CODE))[0] == "count1"
