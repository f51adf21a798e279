"""Learning curves as a picture."""

from collections.abc import Callable, Mapping
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator

from api_schemas.rounds import ModelError, ModelErrorCurve

COLOURS = ("#1f6f8b", "#d1495b", "#66a182", "#edae49", "#6c4f82", "#5c5c5c")
MOST_TICKS = 10
Metric = Callable[[ModelError], float | None]


def draw_learning_curves(curves: Mapping[str, ModelErrorCurve], path: Path) -> None:
    """Write a figure of held-out loss and Dynamics Accuracy against labels, one line a name, to `path`."""
    figure = Figure(figsize=(9.0, 3.8), dpi=150, layout="constrained")
    loss, accuracy = figure.subplots(1, 2)
    _draw(loss, curves, "test loss (nats per transition)", lambda error: error.loss)
    _draw(accuracy, curves, "Dynamics Accuracy (%)", lambda error: _percent(error.dynamics_accuracy))
    loss.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _draw(axes: Axes, curves: Mapping[str, ModelErrorCurve], title: str, metric: Metric) -> None:
    for index, (name, curve) in enumerate(curves.items()):
        points = [(point.labels, metric(point.model_error)) for point in curve.points]
        known = [(labels, value) for labels, value in points if value is not None]
        colour = COLOURS[index % len(COLOURS)]
        axes.plot([x for x, _ in known], [y for _, y in known], marker="o", markersize=4, color=colour, label=name)
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_xlabel("pool labels")
    labels = sorted({point.labels for curve in curves.values() for point in curve.points})
    axes.xaxis.set_major_locator(FixedLocator(labels) if len(labels) <= MOST_TICKS else MaxNLocator(integer=True))
    axes.set_ylim(bottom=0)
    axes.grid(axis="y", color="#e3e3e3", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
