"""What figure 5 tells: every arm's error after its last round beside Random's, and what explains it."""

import csv
import sys
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from statistics import mean

from benchmarks.figures import Figure
from benchmarks.paper import charts
from benchmarks.paper.robots.arms import DEFAULT, EVERYTHING, ORACLE, RANDOM
from benchmarks.paper.runs import Json
from benchmarks.paper.statistics import Estimate, estimate, paired_p

PIXELS = 64 * 64 * 3  # of an image: the published figure may be a sum over them
PUBLISHED = {
    "Lift": 0.87,
    "PickPlaceCan": 0.86,
    "NutAssemblySquare": 0.76,
    "PullCube": 0.74,
    "PokeCube": 0.79,
    "LiftPegUpright": 0.75,
}
"""The default arm's error beside Random's at 1,000 trajectories, read off the published figure."""
Results = dict[str, dict[int, Json]]  # by arm and seed, of one task and one number of trajectories
Measure = Callable[[Json], float | None]  # of one round


def error(horizon: int, stream: str | None = None) -> Measure:
    """Of the validating stage, open-loop; without a stream what there is of pixels, else of numbers."""

    def read(told: Json) -> float | None:
        found: dict[str, float] = told["errors"][str(horizon)]
        return found.get(stream or main_stream(told))

    return read


def main_stream(told: Json) -> str:
    """What the error of a round is of."""
    return "pixels" if "pixels" in told["errors"]["32"] else "proprioception"


def rank(loss: str) -> Measure:
    """Spearman of the arm's score with a true loss, over segments of the pool."""

    def read(told: Json) -> float | None:
        value: float | None = told["ranks"].get(loss)
        return value

    return read


FINAL: dict[str, Measure] = {
    "8 steps": error(8),
    "32 steps": error(32),
    "proprioception, 8": error(8, "proprioception"),
    "proprioception, 32": error(32, "proprioception"),
}
"""After the last round."""
CHOOSING: dict[str, Measure] = {
    "rank of own loss": rank("own"),
    "rank of pixels": rank("pixels"),
    "rank of proprioception": rank("proprioception"),
    "inverse": lambda told: told["inverse"],
}
"""In the rounds that choose: means over them."""


def tell(found: Sequence[Json], expected: int, out: Path, targets: bool = True) -> list[Figure]:
    """Print tables and keep them as CSV, draw charts; the figures, marked where some of `expected` runs are missing.

    targets: whether the default arm is held against the published figure, if no run is missing.
    """
    comparisons = _grouped(found)
    partial = "" if len(found) >= expected else f", partial: {len(found)} of {expected} runs"
    if partial:
        print(f"Not all runs have ended{partial}: figures may change.")
    figures = list[Figure]()
    for (task, warm), arms in comparisons.items():
        rows = table(arms)
        print(f"{task}, {warm} labeled trajectories at first{partial}")
        csv.writer(sys.stdout, delimiter="|").writerows(rows)
        with (out / f"5-{task}-{warm}.csv").open("w", newline="") as file:
            csv.writer(file).writerows(rows)
        explain(arms)
        figures += _figures(task, warm, arms, partial, targets)
    _draw(comparisons, out)
    return figures


def table(arms: Results) -> list[list[str]]:
    """A row an arm, over its seeds; errors as they are, the sum over an image's pixels, and relative to Random."""
    random = arms.get(RANDOM.name, {})
    head = ["arm", "seeds", "labels", *FINAL, "32 steps, sum", "of random", "p", *CHOOSING]
    rows = [
        [
            arm,
            str(len(seeds)),
            str(_labels(seeds)),
            *_final(seeds),
            _sum(seeds),
            *_beside(seeds, random),
            *_ranks(seeds),
        ]
        for arm, seeds in arms.items()
    ]
    still = next(iter(next(iter(arms.values())).values()))["still"]
    stream = "pixels" if "pixels" in still["32"] else "proprioception"
    cells = [still[h][s] for s in (stream, "proprioception") for h in ("8", "32")]
    return [head, *rows, ["standing still", "", "", *(f"{each:.3g}" for each in cells)]]


def explain(arms: Results) -> None:
    """Does more data help at all, does it help to know the true losses, and do arms pick alike?"""
    random = arms.get(RANDOM.name, {})
    for name, question in ((EVERYTHING, "the whole pool labeled"), (ORACLE.name, "chosen by the true loss")):
        if arms.keys() >= {name, RANDOM.name}:
            print(f"{question}: {ratio(arms[name], random, error(32)):.3f} of random's error at 32 steps")
    first = _first_errors(arms)
    if first and random:
        print(f"random after its rounds: {_mean_last(random, error(32)) / mean(first):.3f} of the warm-up's error")
    for left, right in combinations([arm for arm in arms if arm != EVERYTHING], 2):
        rounds = [f"{value:.2f}" for value in jaccard(arms[left], arms[right])]
        print(f"picks of {left} and {right} in common (Jaccard), by round: {', '.join(rounds)}")
    for arm, seeds in arms.items():
        if arm != EVERYTHING:
            print(f"picks of {arm}: {_sources(seeds)}")


def jaccard(left: dict[int, Json], right: dict[int, Json]) -> list[float]:
    """Of all that two arms have picked up to each round, mean over the seeds that both have."""
    shared = sorted(left.keys() & right.keys())
    rounds = len(next(iter(left.values()))["rounds"]) - 1
    return [mean(_common(left[seed], right[seed], number) for seed in shared) for number in range(rounds) if shared]


def ratio(left: dict[int, Json], right: dict[int, Json], measured: Measure) -> float:
    """Mean over mean after the last round, over the seeds that both have."""
    pairs = _pairs(left, right, measured)
    return sum(one for one, _ in pairs) / sum(other for _, other in pairs)


def _figures(task: str, warm: int, arms: Results, partial: str, targets: bool) -> list[Figure]:
    """Every arm beside Random; the default arm with the published ratio as target."""
    random, told = arms.get(RANDOM.name, {}), list[Figure]()
    for arm, seeds in arms.items():
        if arm != RANDOM.name and seeds.keys() & random.keys():
            target = PUBLISHED.get(task) if targets and arm == DEFAULT.name and not partial else None
            name, value = f"5_{task}_{warm}_{arm}_of_random", ratio(seeds, random, error(32))
            told.append(Figure(name, value, f"ratio of errors at 32 steps{partial}", target, "below"))
        for measure, loss in (("own", rank("own")), ("decoded", rank("pixels"))):
            values = _choosing(seeds, loss)
            if values:
                told.append(Figure(f"5_{task}_{warm}_{arm}_spearman_{measure}", mean(values), f"rho{partial}"))
    return told


def _grouped(found: Sequence[Json]) -> dict[tuple[str, int], Results]:
    comparisons = dict[tuple[str, int], Results]()
    for each in found:
        arms = comparisons.setdefault((each["task"], each["warm"]), {})
        arms.setdefault(each["arm"], {})[each["seed"]] = each
    return comparisons


def _final(seeds: dict[int, Json]) -> list[str]:
    return [_cell(_last(seeds, measured)) for measured in FINAL.values()]


def _sum(seeds: dict[int, Json]) -> str:
    first = next(iter(seeds.values()))["rounds"][-1]
    if main_stream(first) != "pixels":
        return ""
    return _cell([value * PIXELS for value in _last(seeds, error(32))])


def _beside(seeds: dict[int, Json], random: dict[int, Json]) -> list[str]:
    pairs = _pairs(seeds, random, error(32))
    if seeds is random or not pairs:
        return ["", ""]
    left, right = zip(*pairs, strict=True)
    return [f"{sum(left) / sum(right):.3f}", f"{paired_p(left, right):.3f}" if len(pairs) > 1 else ""]


def _ranks(seeds: dict[int, Json]) -> list[str]:
    return [_cell(_choosing(seeds, measured)) for measured in CHOOSING.values()]


def _cell(values: Sequence[float]) -> str:
    return str(estimate(values)) if values else ""


def _last(seeds: dict[int, Json], measured: Measure) -> list[float]:
    values = [measured(each["rounds"][-1]) for each in seeds.values()]
    return [value for value in values if value is not None]


def _choosing(seeds: dict[int, Json], measured: Measure) -> list[float]:
    """Of each seed the mean over the rounds that choose."""
    told = [[measured(each) for each in seed["rounds"][:-1]] for seed in seeds.values()]
    known = [[value for value in values if value is not None] for values in told]
    return [mean(values) for values in known if values]


def _pairs(left: dict[int, Json], right: dict[int, Json], measured: Measure) -> list[tuple[float, float]]:
    seeds = sorted(left.keys() & right.keys())
    pairs = [(measured(left[seed]["rounds"][-1]), measured(right[seed]["rounds"][-1])) for seed in seeds]
    return [(one, other) for one, other in pairs if one is not None and other is not None]


def _labels(seeds: dict[int, Json]) -> str:
    """Of any seed: the warm-up's segments differ by a few."""
    return str(next(iter(seeds.values()))["rounds"][-1]["labels"])


def _first_errors(arms: Results) -> list[float]:
    """Of the warm-up, which all arms share."""
    found = {seed: error(32)(each["rounds"][0]) for seeds in arms.values() for seed, each in seeds.items()}
    return [value for value in found.values() if value is not None]


def _mean_last(seeds: dict[int, Json], measured: Measure) -> float:
    return mean(_last(seeds, measured))


def _common(left: Json, right: Json, number: int) -> float:
    picked = [
        {tuple(segment) for each in result["rounds"][: number + 1] for segment in each["picks"]["segments"]}
        for result in (left, right)
    ]
    return len(picked[0] & picked[1]) / max(1, len(picked[0] | picked[1]))


def _sources(seeds: dict[int, Json]) -> str:
    """How many of each source, in all rounds, mean over the seeds."""
    total = dict[str, int]()
    for each in seeds.values():
        for told in each["rounds"]:
            for source, count in told["picks"]["sources"].items():
                total[source] = total.get(source, 0) + count
    return ", ".join(f"{source} {total[source] / len(seeds):.1f}" for source in sorted(total))


def _draw(comparisons: dict[tuple[str, int], Results], out: Path) -> None:
    """Per task: errors over the rounds at each number of trajectories, and, of several, errors over that number."""
    tasks, label = dict[str, dict[int, Results]](), "error at 32 steps"
    for (task, warm), arms in comparisons.items():
        tasks.setdefault(task, {})[warm] = arms
    for task, by_warm in tasks.items():
        for warm, arms in by_warm.items():
            charts.curves(_over_rounds(arms), "labeled segments", label, out / f"5-{task}-{warm}.png")
        if len(by_warm) > 1:
            charts.curves(_over_trajectories(by_warm), "labeled trajectories", label, out / f"5-{task}.png")


def _over_rounds(arms: Results) -> dict[str, list[tuple[float, Estimate]]]:
    lines = {}
    for arm, seeds in arms.items():
        if arm == EVERYTHING:  # it has many times the labels
            continue
        rounds = list(zip(*(each["rounds"] for each in seeds.values()), strict=True))
        lines[arm] = [(float(of[0]["labels"]), estimate([error(32)(each) or 0.0 for each in of])) for of in rounds]
    return lines


def _over_trajectories(by_warm: dict[int, Results]) -> dict[str, list[tuple[float, Estimate]]]:
    lines = dict[str, list[tuple[float, Estimate]]]()
    for warm, arms in sorted(by_warm.items()):
        for arm, seeds in arms.items():
            lines.setdefault(arm, []).append((float(warm), estimate(_last(seeds, error(32)))))
    return lines
