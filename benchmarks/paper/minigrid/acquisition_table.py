"""What figure 4d tells: every arm after its last batch beside Random, learning curves, and the default's targets."""

import csv
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.figures import Figure
from benchmarks.paper import charts
from benchmarks.paper.minigrid.arms import Arm
from benchmarks.paper.runs import Json
from benchmarks.paper.statistics import Estimate, estimate, labels_to_reach, paired_p

RANDOM, ORACLE = Arm("random", "top"), Arm("oracle", "top")
Results = dict[str, dict[int, Json]]  # by arm's name and seed
Measure = Callable[[Json], float | None]  # of one round


def measure(test: str, group: str, what: str) -> Measure:
    """A part of the model error of a round."""

    def read(told: Json) -> float | None:
        value: float | None = told[test][group][what]
        return value

    return read


def rank(group: str, how: str = "spearman") -> Measure:
    """The rank correlation of score with true loss on data of natural frequency."""

    def read(told: Json) -> float | None:
        value: float | None = told["ranks"].get(group, {}).get(how)
        return value

    return read


LOSS = measure("balanced", "overall", "loss")
EXACT = measure("balanced", "overall", "exact")
NATURAL_LOSS = measure("natural", "overall", "loss")
NATURAL_EXACT = measure("natural", "overall", "exact")
COLUMNS: dict[str, Measure] = {
    "loss": LOSS,
    "moving": measure("balanced", "movement", "loss"),
    "interacting": measure("balanced", "interaction", "loss"),
    "exact": EXACT,
    "dynamics": measure("balanced", "overall", "dynamics"),
    "dynamics moving": measure("balanced", "movement", "dynamics"),
    "dynamics interacting": measure("balanced", "interaction", "dynamics"),
    "natural loss": NATURAL_LOSS,
    "natural exact": NATURAL_EXACT,
    "inverse": measure("balanced", "overall", "inverse"),
    "natural inverse": measure("natural", "overall", "inverse"),
    "action following": lambda told: told.get("action_following"),
    "rank": rank("overall"),
    "rank moving": rank("movement"),
    "rank interacting": rank("interaction"),
    "kendall": rank("overall", "kendall"),
}


ENOUGH_SEEDS = 6  # with fewer no p of the sign-flip test is below .05, and an interval says little


def tell(found: Sequence[Json], default: Arm, out: Path) -> list[Figure]:
    """Print the table and keep it as CSV, draw the curves; the figures of the default arm, as far as it has run."""
    arms: Results = {}
    for each in found:
        arms.setdefault(each["arm"], {})[each["seed"]] = each
    rows = table(arms, default)
    csv.writer(sys.stdout, delimiter="|").writerows(rows)
    with (out / "4d.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    _draw(arms, out / "4d.png")
    needed = {RANDOM.name, ORACLE.name, default.name}
    return figures(arms, default) if needed <= set(arms) else []


def table(arms: Results, default: Arm) -> list[list[str]]:
    """A row an arm: mean and 95 % interval over the seeds after the last batch; p of its loss against two others'."""
    head = ["arm", "seeds", *COLUMNS, "labels used", "p against random", "p against default"]
    random, chosen = (arms.get(arm.name, {}) for arm in (RANDOM, default))
    return [
        head,
        *(
            [arm, str(len(seeds)), *_cells(seeds), _labels_used(seeds, random), _p(seeds, random), _p(seeds, chosen)]
            for arm, seeds in arms.items()
        ),
    ]


def figures(arms: Results, default: Arm) -> list[Figure]:
    """The default arm beside Random and beside the true loss's top-n, over the seeds that both have."""
    ours, random, oracle = (arms[arm.name] for arm in (default, RANDOM, ORACLE))
    exact, natural_loss, natural_exact = (
        difference(ours, random, measured) for measured in (EXACT, NATURAL_LOSS, NATURAL_EXACT)
    )
    used = [labels_used(*pair) for pair in _pairs(ours, random)]
    enough = len(used) >= ENOUGH_SEEDS
    return [
        Figure(
            "4d_labels_used", estimate([1.0 if share is None else share for share in used]).mean, "share", 0.4, "below"
        ),
        Figure("4d_seeds_that_reach_random", sum(share is not None for share in used) / len(used), "share", 1.0),
        Figure("4d_loss_of_random", ratio(ours, random, LOSS), "ratio", 0.4, "below"),
        Figure("4d_loss_of_oracle_top", ratio(ours, oracle, LOSS), "ratio", 0.65, "below"),
        Figure("4d_p_random", paired(ours, random, LOSS), "p", 0.05 if enough else None, "below"),
        Figure("4d_p_oracle_top", paired(ours, oracle, LOSS), "p", 0.05 if enough else None, "below"),
        Figure("4d_exact_above_random", exact.mean, "share", 0.0),
        # Not worse: all of the 95 % interval of the difference lies on the right side of 0.
        Figure("4d_natural_loss_above_random", natural_loss.mean, "nats"),
        Figure("4d_natural_loss_above_random_at_most", _most(natural_loss), "nats", 0.0 if enough else None, "below"),
        Figure("4d_natural_exact_above_random", natural_exact.mean, "share"),
        Figure("4d_natural_exact_above_random_at_least", _least(natural_exact), "share", 0.0 if enough else None),
        *_rivals(arms, default),
        *_ranks(ours),
    ]


def _most(difference: Estimate) -> float:
    return difference.mean + difference.half_width


def _least(difference: Estimate) -> float:
    return difference.mean - difference.half_width


def _rivals(arms: Results, default: Arm) -> list[Figure]:
    """The default's loss beside that of each other strategy under the same rule, for the record."""
    told, ours = [], arms[default.name]
    for name, seeds in arms.items():
        if Arm.parse(name).rule == default.rule and name != default.name and ours.keys() & seeds.keys():
            strategy = Arm.parse(name).strategy
            told.append(Figure(f"4d_loss_of_{strategy}", ratio(ours, seeds, LOSS), "ratio"))
            told.append(Figure(f"4d_p_{strategy}", paired(ours, seeds, LOSS), "p"))
    return told


def _ranks(ours: dict[int, Json]) -> list[Figure]:
    told = []
    for number in range(len(next(iter(ours.values()))["rounds"])):
        for group, target in (("overall", 0.9), ("movement", None), ("interaction", None)):
            values = [rank(group)(each["rounds"][number]) or 0.0 for each in ours.values()]
            told.append(Figure(f"4d_spearman_{group}_round_{number + 1}", estimate(values).mean, "rho", target))
    return told


def difference(left: dict[int, Json], right: dict[int, Json], measured: Measure) -> Estimate:
    """left - right after the last batch, paired by seed."""
    return estimate([one - other for one, other in _last(left, right, measured)])


def ratio(left: dict[int, Json], right: dict[int, Json], measured: Measure) -> float:
    """Mean over mean after the last batch, over the seeds that both have."""
    pairs = _last(left, right, measured)
    return sum(one for one, _ in pairs) / sum(other for _, other in pairs)


def paired(left: dict[int, Json], right: dict[int, Json], measured: Measure) -> float:
    """p of the sign-flip test over the seeds that both have."""
    pairs = _last(left, right, measured)
    return paired_p([one for one, _ in pairs], [other for _, other in pairs])


def labels_used(result: Json, random: Json) -> float | None:
    """Of the labels that Random acquired, the share with which the arm reaches Random's final loss."""
    labels, losses = curve(result)
    reached = labels_to_reach(labels, losses, curve(random)[1][-1])
    return None if reached is None else (reached - labels[0]) / (labels[-1] - labels[0])


def curve(result: Json) -> tuple[list[int], list[float]]:
    """Labels, and the loss on the balanced test."""
    rounds = result["rounds"]
    return [each["labels"] for each in rounds], [LOSS(each) or 0.0 for each in rounds]


def _pairs(left: dict[int, Json], right: dict[int, Json]) -> list[tuple[Json, Json]]:
    return [(left[seed], right[seed]) for seed in sorted(left.keys() & right.keys())]


def _last(left: dict[int, Json], right: dict[int, Json], measured: Measure) -> list[tuple[float, float]]:
    pairs = [(measured(one["rounds"][-1]), measured(other["rounds"][-1])) for one, other in _pairs(left, right)]
    return [(one, other) for one, other in pairs if one is not None and other is not None]


def _cells(seeds: dict[int, Json]) -> list[str]:
    cells = []
    for column in COLUMNS.values():
        values = [value for value in (column(each["rounds"][-1]) for each in seeds.values()) if value is not None]
        cells.append(str(estimate(values)) if values else "")
    return cells


def _labels_used(seeds: dict[int, Json], random: dict[int, Json]) -> str:
    """Share of Random's labels, over the seeds that reach its final loss."""
    pairs = _pairs(seeds, random)
    if not pairs:
        return ""
    used = [share for share in (labels_used(*pair) for pair in pairs) if share is not None]
    reached = str(estimate(used)) if used else "never"
    return f"{reached} ({len(used)} of {len(pairs)})" if 0 < len(used) < len(pairs) else reached


def _p(seeds: dict[int, Json], others: dict[int, Json]) -> str:
    """Of the final loss; of an arm against itself there is none."""
    return f"{paired(seeds, others, LOSS):.3f}" if seeds is not others and _pairs(seeds, others) else ""


def _draw(arms: Results, path: Path) -> None:
    lines = {}
    for arm, seeds in arms.items():
        curves = [curve(each) for each in seeds.values()]
        labels = curves[0][0]
        points = [estimate([losses[place] for _, losses in curves]) for place in range(len(labels))]
        lines[arm] = list(zip(map(float, labels), points, strict=True))
    charts.curves(lines, "labels", "next-state loss, nats, balanced test", path)
