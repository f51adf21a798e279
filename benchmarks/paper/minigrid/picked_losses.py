"""Figure 8: the true loss of what each strategy picked, from the finished results of figure 4d.

    python -m benchmarks.paper.minigrid.picked_losses --results results/paper/minigrid/4d

The loss is the world model's at the time of the pick, the smallest over the actions that explain the segment. Whoever
picks well picks what the model does not know yet, and not only the worst of one kind.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.figures import Figure, finish
from benchmarks.paper import charts
from benchmarks.paper.minigrid.rooms import Rooms
from benchmarks.paper.runs import Json, add_options, read

SHARES = (0.05, 0.25, 0.5, 0.75, 0.95)
Losses = dict[str, dict[int, list[float]]]  # by arm and round, of all seeds


def main(argv: Sequence[str] | None = None) -> list[Figure]:
    """Print the table and draw the chart. No figure has a target."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_options(parser, "8")
    parser.add_argument("--results", type=Path, default=Path("results/paper/minigrid/4d"), help="of figure 4d")
    asked = parser.parse_args(argv)
    found = losses(finished(asked.results, asked.tuning))
    if not found:
        print(
            f"{asked.results} holds no finished result of figure 4d: run benchmarks.paper.minigrid.acquisition first."
        )
        return []
    print_table(found)
    asked.out.mkdir(parents=True, exist_ok=True)
    boxes = {arm: [loss for values in rounds.values() for loss in values] for arm, rounds in found.items()}
    charts.boxes(boxes, "true loss of what was picked, nats", asked.out / "8.png")
    return [Figure(f"8_median_{arm}", float(np.median(values)), "nats") for arm, values in boxes.items()]


def finished(folder: Path, tuning: bool) -> list[Json]:
    """Results of figure 4d in its own rooms, reported or for tuning; none of others' files, nor of other code."""
    told = [read(path) for path in sorted(folder.glob("*.json"))]
    words = list(Rooms(folder / "data", tuning).words)
    return [each for each in told if each is not None and each.get("rooms") == words]


def losses(results: Sequence[Json]) -> Losses:
    """True losses of all picks. The last round picks nothing."""
    found: Losses = {}
    for result in results:
        rounds = found.setdefault(result["arm"], {})
        for number, told in enumerate(result["rounds"], 1):
            if told["picks"]:
                rounds.setdefault(number, []).extend(told["picks"]["true_losses"])
    return found


def print_table(found: Losses) -> None:
    """Quantiles of each arm's picks, round by round."""
    print(" | ".join(("arm", "round", "picks", "mean", *(f"{share:.0%}" for share in SHARES))))
    for arm, rounds in found.items():
        for number, values in sorted(rounds.items()):
            cells = [f"{value:.3g}" for value in (np.mean(values), *np.quantile(values, SHARES))]
            print(" | ".join((arm, str(number), str(len(values)), *cells)))


if __name__ == "__main__":
    finish(main())
