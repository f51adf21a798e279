"""Every figure of MiniGrid, one after another, with all targets at the end.

    python -m benchmarks.paper.minigrid             every arm under top-n and the default rule; 90 minutes is the aim
    python -m benchmarks.paper.minigrid --quick     4a and 4d with four arms, 3 seeds; 10 minutes is the aim
    python -m benchmarks.paper.minigrid --full      every arm under every batch rule too, 3 seeds

Finished runs are not repeated: a benchmark that was stopped goes on where it was. Status 1 where a target is missed.
"""

import argparse
import multiprocessing
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

from api_schemas.strategies import DEFAULT_BATCH_RULE, DEFAULT_STRATEGY
from benchmarks.figures import Figure, finish

Extent = Literal["quick", "usual", "full"]
FEW = ("random:top", "oracle:top", *(f"{each}:{DEFAULT_BATCH_RULE}" for each in (DEFAULT_STRATEGY, "self_inverse")))
# The arms with 10 seeds. uncertainty takes four times as long as others: it has five world models to train.
MANY_SEEDS = tuple(dict.fromkeys((*FEW, *(f"{each}:{DEFAULT_BATCH_RULE}" for each in ("cycle", "uncertainty")))))


@dataclass(frozen=True)
class Part:
    """One figure's module, the folder of its results, and its options."""

    module: str
    folder: str
    options: tuple[str, ...] = ()

    def main(self, shared: Sequence[str], out: Path) -> list[Figure]:
        """Run it. The module, with torch, is imported now."""
        module = import_module(f"benchmarks.paper.minigrid.{self.module}")
        figures: list[Figure] = module.main([*shared, "--out", str(out / self.folder), *self.options])
        return figures


def parts(extent: Extent, out: Path) -> list[Part]:
    """What runs, in order: what is quick first, 4d last but for the figure that only reads its results."""
    if extent == "quick":
        return [
            Part("inverse_accuracy", "4a", ("--seeds", "3", "--labels", "1556")),
            Part("acquisition", "4d", ("--seeds", "3", "--arms", *FEW)),
        ]
    return [
        Part("inverse_accuracy", "4a"),
        Part("prediction", "prediction", () if extent == "full" else ("--draws", "balanced")),
        Part("predictions", "9"),
        Part("foreign_path", "foreign"),
        Part("acquisition", "4d", ("--seeds", "10", "--arms", *MANY_SEEDS)),
        Part("acquisition", "4d", ("--seeds", "5", "--arms", *_arms())),
        *([Part("acquisition", "4d", ("--seeds", "3", "--arms", *_grid()))] if extent == "full" else []),
        Part("picked_losses", "8", ("--results", str(out / "4d"))),
    ]


def run(chosen: Sequence[Part], shared: Sequence[str], out: Path) -> list[Figure]:
    """One after another; a missed target stops none."""
    told = dict[str, Figure]()
    for part in chosen:
        began = time.monotonic()
        print(f"{part.module}: begins", flush=True)
        figures = part.main(shared, out)
        for figure in figures:
            told.setdefault(figure.name, figure)  # told twice it counts by the first part, the one with more seeds
        missed = sum(not figure.met for figure in figures)
        print(f"{part.module}: {time.monotonic() - began:.0f} s, {missed} targets missed", flush=True)
    return list(told.values())


def main(argv: Sequence[str] | None = None) -> list[Figure]:
    """All figures of the extent that was asked for."""
    parser = argparse.ArgumentParser(prog="benchmarks.paper.minigrid", description=(__doc__ or "").partition("\n")[0])
    extent = parser.add_mutually_exclusive_group()
    extent.add_argument("--quick", dest="extent", action="store_const", const="quick", help="4a and 4d, four arms")
    extent.add_argument("--full", dest="extent", action="store_const", const="full", help="all arms and batch rules")
    parser.add_argument("--out", type=Path, default=Path("results/paper/minigrid"))
    parser.add_argument("--processes", type=int, default=multiprocessing.cpu_count())
    parser.add_argument("--threads", type=int, default=1, help="of torch, in each process")
    parser.add_argument("--tuning", action="store_true", help="rooms that no table reports")
    asked = parser.parse_args(argv)
    shared = ["--processes", str(asked.processes), "--threads", str(asked.threads)]
    shared += ["--tuning"] if asked.tuning else []
    return run(parts(asked.extent or "usual", asked.out), shared, asked.out)


def _arms() -> list[str]:
    """Every strategy under top-n and the default rule, explore mode under the latter. What draws by chance has none."""
    from benchmarks.paper.minigrid.arms import CHANCE, EXPLORE
    from models.acquisition import STRATEGIES

    scored = [name for name in sorted(STRATEGIES) if name != "random"]
    explored = [f"{CHANCE}:top", f"{EXPLORE}:{DEFAULT_BATCH_RULE}"]
    return ["random:top", *(f"{name}:{rule}" for name in scored for rule in ("top", DEFAULT_BATCH_RULE)), *explored]


def _grid() -> list[str]:
    """Every arm that there is under every rule, controls too."""
    from benchmarks.paper.minigrid.arms import ALL, CHANCE
    from models.acquisition import BATCH_RULES

    scored = [name for name in sorted(ALL) if name not in ("random", CHANCE)]
    return ["random:top", f"{CHANCE}:top", *(f"{name}:{rule}" for rule in BATCH_RULES for name in scored)]


if __name__ == "__main__":
    finish(main())
