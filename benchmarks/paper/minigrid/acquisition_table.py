"""The table of figure 4d: every arm after its last batch, beside Random."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper.minigrid.arms import Arm
from benchmarks.paper.statistics import estimate, labels_to_reach, paired_p

Json = dict[str, Any]
RANDOM = Arm("random", "top")
COLUMNS: dict[str, Callable[[Json], float | None]] = {
    "loss": lambda last: last["balanced"]["overall"]["loss"],
    "moving": lambda last: last["balanced"]["movement"]["loss"],
    "interacting": lambda last: last["balanced"]["interaction"]["loss"],
    "exact": lambda last: last["balanced"]["overall"]["exact"],
    "dynamics": lambda last: last["balanced"]["overall"]["dynamics"],
    "natural loss": lambda last: last["natural"]["overall"]["loss"],
    "natural exact": lambda last: last["natural"]["overall"]["exact"],
    "natural moving": lambda last: last["natural"]["movement"]["exact"],
    "rank": lambda last: last["ranks"].get("overall", {}).get("spearman"),
}


def results(arm: Arm, seeds: Sequence[int], out: Path) -> list[Json]:
    """Finished results of an arm, by seed."""
    files = [out / f"{arm.strategy}-{arm.rule}-{seed}.json" for seed in seeds]
    return [json.loads(file.read_text()) for file in files if file.exists()]


def curve(result: Json) -> tuple[list[int], list[float]]:
    """Labels, and the loss on the balanced test."""
    rounds = result["rounds"]
    return [each["labels"] for each in rounds], [each["balanced"]["overall"]["loss"] for each in rounds]


def labels_used(result: Json, random: Json) -> float | None:
    """Of the labels that Random acquired, the share with which the arm reaches Random's final loss."""
    labels, losses = curve(result)
    reached = labels_to_reach(labels, losses, curve(random)[1][-1])
    return None if reached is None else (reached - labels[0]) / (labels[-1] - labels[0])


def print_table(arms: Sequence[Arm], seeds: Sequence[int], out: Path) -> None:
    """Mean and 95 % interval over the seeds of each column, and p of the loss against Random's."""
    random = {each["seed"]: each for each in results(RANDOM, seeds, out)}
    print(" | ".join(("arm", "seeds", *COLUMNS, "labels used", "p")))
    for arm in arms:
        found = results(arm, seeds, out)
        if found:
            print(" | ".join((arm.name, str(len(found)), *_cells(found), *_beside(found, random))))


def _cells(found: Sequence[Json]) -> list[str]:
    cells = []
    for column in COLUMNS.values():
        values = [value for value in (column(each["rounds"][-1]) for each in found) if value is not None]
        cells.append(str(estimate(values)) if values else "")
    return cells


def _beside(found: Sequence[Json], random: dict[int, Json]) -> list[str]:
    """Share of Random's labels, and p of the final loss."""
    pairs = [(each, random[each["seed"]]) for each in found if each["seed"] in random]
    if not pairs:
        return ["", ""]
    used = [share for share in (labels_used(*pair) for pair in pairs) if share is not None]
    reached = str(estimate(used)) if used else "never"
    if 0 < len(used) < len(pairs):
        reached += f" ({len(used)} of {len(pairs)})"
    left, right = ([curve(pair[side])[1][-1] for pair in pairs] for side in (0, 1))
    return [reached, f"{paired_p(left, right):.3f}"]
