"""Charts of the figures, as PNG files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.paper.statistics import Estimate

SIZE = (9.0, 4.5)  # inches
DOTS = 120  # an inch


def bars(groups: Mapping[str, Sequence[Estimate]], names: Sequence[str], label: str, path: Path) -> None:
    """A group of bars for each of `names`, one bar a key of `groups`, with 95 % intervals."""
    figure, axes = _empty(label)
    width = 0.8 / len(groups)
    for place, (group, values) in enumerate(groups.items()):
        x = np.arange(len(names)) + (place - (len(groups) - 1) / 2) * width
        axes.bar(x, [each.mean for each in values], width, yerr=_errors(values), label=group, capsize=2)
    axes.set_xticks(range(len(names)), names)
    _save(figure, axes, path)


def curves(groups: Mapping[str, Sequence[tuple[float, Estimate]]], across: str, label: str, path: Path) -> None:
    """A line a key of `groups` through its (x, value) points, with 95 % intervals."""
    figure, axes = _empty(label)
    for group, points in groups.items():
        values = [value for _, value in points]
        axes.errorbar([x for x, _ in points], [each.mean for each in values], _errors(values), label=group, capsize=2)
    axes.set_xticks(sorted({x for points in groups.values() for x, _ in points}))
    axes.set_xlabel(across)
    _save(figure, axes, path)


def boxes(groups: Mapping[str, Sequence[float]], label: str, path: Path) -> None:
    """A box a key of `groups` around its values: quartiles, whiskers to the 5th and 95th percentile."""
    figure, axes = _empty(label)
    figure.set_size_inches(max(SIZE[0], 0.5 * len(groups)), SIZE[1])
    axes.boxplot(list(groups.values()), tick_labels=list(groups), whis=(5, 95), showfliers=False)
    axes.set_yscale("symlog")
    axes.tick_params(axis="x", rotation=90 if len(groups) > 8 else 15, labelsize="small")
    figure.savefig(path)


def _empty(label: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=SIZE, dpi=DOTS, layout="constrained")
    axes = figure.add_subplot()
    axes.set_ylabel(label)
    axes.grid(axis="y", alpha=0.3)
    return figure, axes


def _errors(values: Sequence[Estimate]) -> list[float]:
    """No bar for a single seed, whose interval is without end."""
    return [each.half_width if np.isfinite(each.half_width) else 0.0 for each in values]


def _save(figure: Figure, axes: Axes, path: Path) -> None:
    axes.legend(fontsize="small", ncols=2)
    figure.savefig(path)
