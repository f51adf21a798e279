"""The entry that runs all figures: in order, past missed targets, status 1 at the end."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from benchmarks.figures import Figure, finish
from benchmarks.paper.minigrid.__main__ import Part, parts, run
from benchmarks.paper.minigrid.arms import Arm


@dataclass(frozen=True)
class Told(Part):
    """A part that tells what it is given to tell."""

    told: list[Figure] = field(default_factory=list)

    def main(self, shared: Sequence[str], out: Path) -> list[Figure]:
        """Without running anything."""
        return self.told


def test_a_missed_target_stops_nothing_and_is_told_at_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    chosen = [
        Told("4a", "4a", (), [Figure("pickup", 0.5, "share", 0.98)]),
        Told("4d", "4d", (), [Figure("loss", 1, "nats")]),
    ]
    figures = run(chosen, [], Path())
    assert [figure.name for figure in figures] == ["pickup", "loss"]
    with pytest.raises(SystemExit) as ended:
        finish(figures)
    assert ended.value.code == 1
    assert "pickup 0.5 share (target >= 0.98)  MISSED\nloss 1 nats\n" in capsys.readouterr().out


def test_a_figure_that_is_told_twice_counts_by_its_first_value() -> None:
    """The arms of 4d run in two parts; the first has more seeds."""
    chosen = [Told("4d", "4d", (), [Figure("loss", value, "nats")]) for value in (3.0, 1.0)]
    assert [figure.value for figure in run(chosen, [], Path())] == [3.0]


def test_every_arm_of_every_extent_exists() -> None:
    for extent in ("quick", "usual", "full"):
        chosen = parts(extent, Path("results"))
        arms = [word for part in chosen for word in part.options if ":" in word]
        assert arms
        assert all(Arm.parse(arm).name == arm for arm in arms)


def test_the_quick_extent_is_4a_and_4d_with_four_arms_and_three_seeds() -> None:
    inverse, acquisition = parts("quick", Path("results"))
    assert (inverse.folder, acquisition.folder) == ("4a", "4d")
    assert all(part.options[:2] == ("--seeds", "3") for part in (inverse, acquisition))
    assert len(acquisition.options) == 3 + 4


def test_4d_comes_last_but_for_what_reads_its_results() -> None:
    assert [part.folder for part in parts("usual", Path("results"))][-3:] == ["4d", "4d", "8"]


def test_a_part_runs_its_module_with_the_shared_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chosen = [part for part in parts("usual", tmp_path) if part.folder == "8"]
    assert run(chosen, ["--processes", "1", "--threads", "1", "--tuning"], tmp_path) == []
    said = capsys.readouterr().out
    assert f"{tmp_path / '4d'} holds no finished result" in said
    assert "s, 0 targets missed" in said
