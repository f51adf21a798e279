"""What figure 4d tells, of results whose answers are known."""

import csv
from pathlib import Path

import pytest

from benchmarks.paper.minigrid.acquisition_table import labels_used, table, tell
from benchmarks.paper.minigrid.arms import Arm
from benchmarks.paper.runs import Json

OURS = Arm("cycle", "signatures")
LABELS = (200, 300, 400, 500)
Curve = tuple[float, float, float, float]


def test_the_default_is_held_against_random_and_the_oracle(tmp_path: Path) -> None:
    """Random comes from 10 down to 4; ours is there after half of the first batch and ends at 1."""
    found = [
        *_arm("random:top", (10, 8, 6, 4), exact=0.6, natural_loss=1.0),
        *_arm("oracle:top", (10, 5, 3, 2), exact=0.5, natural_loss=2.0),
        *_arm("cycle:signatures", (10, -2, 1.5, 1), exact=0.9, natural_loss=0.5, spearman=0.95),
        *_arm("self_inverse:signatures", (10, 5, 3, 2), exact=0.9, natural_loss=0.5),
        *_arm("self_inverse:top", (10, 5, 3, 2), exact=0.9, natural_loss=0.5),
    ]
    told = {figure.name: figure for figure in tell(found, OURS, tmp_path)}
    values = {
        "4d_labels_used": 1 / 6,
        "4d_loss_of_random": 1 / 4,
        "4d_loss_of_oracle_top": 1 / 2,
        "4d_p_random": 1 / 32,
        "4d_exact_above_random": 0.3,
        "4d_natural_loss_above_random": -0.5,
        "4d_natural_loss_above_random_at_most": -0.5,
        "4d_natural_exact_above_random_at_least": 0.3,
        "4d_spearman_overall_round_4": 0.95,
        "4d_loss_of_self_inverse": 1 / 2,
        "4d_p_self_inverse": 1 / 32,
    }
    assert {name: told[name].value for name in values} == pytest.approx(values)
    assert [name for name, figure in told.items() if not figure.met] == []
    assert (tmp_path / "4d.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "4d.csv").open() as file:
        assert [row[:2] for row in csv.reader(file)][1:] == [
            [arm, "6"] for arm in ("random:top", "oracle:top", OURS.name, "self_inverse:signatures", "self_inverse:top")
        ]


def test_who_is_only_perhaps_no_worse_misses(tmp_path: Path) -> None:
    """Better on the mean, but the interval reaches to the wrong side."""
    found = [
        *_arm("random:top", (4, 3, 2, 2), natural_loss=1.0),
        *_arm("oracle:top", (4, 3, 2, 2)),
        *_arm("cycle:signatures", (4, 1, 1, 1), natural_loss=0.99, spread=0.1),
    ]
    told = {figure.name: figure for figure in tell(found, OURS, tmp_path)}
    assert told["4d_natural_loss_above_random"].value == pytest.approx(-0.01)
    assert told["4d_natural_loss_above_random_at_most"].value > 0
    assert not told["4d_natural_loss_above_random_at_most"].met


def test_of_few_seeds_no_p_and_no_interval_is_asked(tmp_path: Path) -> None:
    found = [
        *_arm("random:top", (4, 3, 2, 2), natural_loss=1.0, seeds=5),
        *_arm("oracle:top", (4, 3, 2, 2), seeds=5),
        *_arm("cycle:signatures", (4, 1, 1, 0.5), natural_loss=0.99, spread=0.1, seeds=5, exact=0.9, spearman=0.95),
    ]
    told = {figure.name: figure for figure in tell(found, OURS, tmp_path)}
    assert told["4d_p_random"].value == pytest.approx(1 / 16)
    assert [name for name, figure in told.items() if not figure.met] == []


def test_without_the_arms_to_compare_there_is_a_table_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tell(_arm("cycle:signatures", (4, 3, 2, 1)), OURS, tmp_path) == []
    assert "cycle:signatures|6|1 ± 0|" in capsys.readouterr().out


def test_an_arm_stands_beside_random_and_beside_the_default() -> None:
    arms = {
        arm: {each["seed"]: each for each in _arm(arm, losses)}
        for arm, losses in (
            ("random:top", (10.0, 8.0, 6.0, 4.0)),
            ("cycle:signatures", (10.0, 4.0, 2.0, 1.0)),
            ("oracle_easy:top", (10.0, 10.0, 9.0, 9.0)),
        )
    }
    head, *rows = table(arms, OURS)
    cells = {row[0]: dict(zip(head, row, strict=True)) for row in rows}
    assert head[-3:] == ["labels used", "p against random", "p against default"]
    assert [cells[arm]["p against random"] for arm in arms] == ["", "0.031", "0.031"]
    assert [cells[arm]["p against default"] for arm in arms] == ["0.031", "", "0.031"]
    assert cells["cycle:signatures"]["labels used"] == "0.333 ± 0"
    assert cells["oracle_easy:top"]["labels used"] == "never"
    assert cells["random:top"]["labels used"] == "1 ± 0"


def test_only_some_seeds_may_reach_it() -> None:
    (random,) = _arm("random:top", (10, 8, 6, 4), seeds=1)
    (ours,) = _arm("cycle:top", (10, 8, 6, 4.5), seeds=1)
    assert labels_used(ours, random) is None
    arms = {"random:top": {0: random, 1: random}, "cycle:top": {0: ours, 1: random}}
    row = table(arms, OURS)[2]
    assert row[-3] == "1 ± inf (1 of 2)"


def _arm(
    name: str,
    losses: Curve,
    exact: float = 0.5,
    natural_loss: float = 1.0,
    spearman: float | None = None,
    spread: float = 0.0,
    seeds: int = 6,
) -> list[Json]:
    """Results of all seeds; natural loss differs from one to the next by `spread`."""
    return [
        {
            "arm": name,
            "seed": seed,
            "rounds": [
                _round(labels, loss, exact, natural_loss + spread * (seed - (seeds - 1) / 2), spearman)
                for labels, loss in zip(LABELS, losses, strict=True)
            ],
        }
        for seed in range(seeds)
    ]


def _round(labels: int, loss: float, exact: float, natural_loss: float, spearman: float | None) -> Json:
    error = {"exact": exact, "dynamics": 0.5, "inverse": 0.5}
    groups = ("overall", "movement", "interaction")
    ranks = {} if spearman is None else {group: {"spearman": spearman, "kendall": 0.5} for group in groups}
    return {
        "labels": labels,
        "balanced": {group: {"loss": loss, **error} for group in groups},
        "natural": {group: {"loss": natural_loss, **error} for group in groups},
        "ranks": ranks,
    }
