"""Learning curves as a picture."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator

from api_schemas.rounds import ModelErrorCurve
from asim import measures
from asim.measures import Measure, Value

COLOURS = ("#1f6f8b", "#d1495b", "#66a182", "#edae49", "#6c4f82", "#5c5c5c")
MOST_TICKS = 10
CHART_WIDTH = 4.5  # inches


def draw_learning_curves(curves: Mapping[str, ModelErrorCurve], path: Path) -> None:
    """Write a figure of held-out errors against labels, one line a name, to `path`: loss and Dynamics Accuracy; of
    robots what is not foreseen, and the open-loop error of each stream beside that of standing still, dotted."""
    charts = _charts(curves)
    figure = Figure(figsize=(CHART_WIDTH * len(charts), 3.8), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(charts))
    for each, measure in zip(axes, charts, strict=True):
        _draw(each, curves, measure)
    axes[0].legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _charts(curves: Mapping[str, ModelErrorCurve]) -> list[Measure]:
    errors = measures.errors_of(curves)
    losses = measures.losses(errors)
    accuracy = [measures.ACCURACY] if measures.NATS in losses else []
    return [*losses, *accuracy, *measures.open_loop(errors)]


def _draw(axes: Axes, curves: Mapping[str, ModelErrorCurve], measure: Measure) -> None:
    scale = 100.0 if measure.percent else 1.0
    for index, (name, curve) in enumerate(curves.items()):
        colour = COLOURS[index % len(COLOURS)]
        _line(axes, curve, measure.value, scale, marker="o", markersize=4, color=colour, label=name)
        _line(axes, curve, measure.still, scale, linestyle=":", linewidth=1, color=colour)
    unit = f"% {measure.unit}" if measure.percent else measure.unit
    axes.set_title(f"{measure.title} ({unit})", loc="left", fontsize=10)
    axes.set_xlabel("pool labels")
    labels = sorted({point.labels for curve in curves.values() for point in curve.points})
    axes.xaxis.set_major_locator(FixedLocator(labels) if len(labels) <= MOST_TICKS else MaxNLocator(integer=True))
    axes.set_ylim(bottom=0)
    axes.grid(axis="y", color="#e3e3e3", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _line(axes: Axes, curve: ModelErrorCurve, value: Value, scale: float, **style: Any) -> None:
    points = [(point.labels, value(point.model_error)) for point in curve.points]
    known = [(labels, scale * found) for labels, found in points if found is not None]
    axes.plot([x for x, _ in known], [y for _, y in known], **style)
