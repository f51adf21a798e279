"""Tables, charts and targets of figures 4b, 4c and noise."""

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

from benchmarks.figures import Figure
from benchmarks.paper import charts
from benchmarks.paper.minigrid.prediction import FORMS, POINTS, Name, Point
from benchmarks.paper.minigrid.prediction_accuracy import FRESH
from benchmarks.paper.minigrid.prediction_data import DRAWS, Draw
from benchmarks.paper.runs import Json
from benchmarks.paper.statistics import Estimate, estimate

AXES: dict[Name, str] = {"4b": "labels", "4c": "objects", "noise": "noisy tiles"}
COUNTED: dict[Name, tuple[str, ...]] = {"4b": ("all",), "4c": ("all",), "noise": ("masked", "all")}
GROUPS = ("overall", "movement", "interaction")
PREDICTORS = ("world_model", *FORMS, *(form + FRESH for form in FORMS))
TARGET, TARGETED = 0.97, "sparse"  # the form that a project trains by default
WITHOUT_SIMULATOR = (
    "The simulator cannot be restored from observations alone, so no inferred action is executed: "
    "beside the world model stands the share of actions inferred right."
)


def print_tables(figures: Sequence[Name], found: Sequence[Json]) -> None:
    """Dynamics Accuracy, with its 95 % interval over seeds, at each point, and the share of actions inferred right."""
    for figure, counted in [(name, counted) for name in figures for counted in COUNTED[name]]:
        print(f"figure {figure}, Dynamics Accuracy of {'all elements' if counted == 'all' else 'all but noisy tiles'}")
        print(" | ".join((AXES[figure], "draw", "seeds", "predictor", *GROUPS, "actions inferred")))
        for point, draw in product(POINTS[figure], DRAWS):
            tests = tests_at(found, point, draw)
            for predictor in predictors_of(tests, counted):
                cells = [str(_estimate(tests, counted, predictor, group)) for group in GROUPS]
                inferred = [each["inferred"][predictor]["overall"] for each in tests if predictor in FORMS]
                cells.append(str(estimate(inferred)) if inferred else "")
                print(" | ".join((str(point.x), draw, str(len(tests)), predictor, *cells)))


def print_file_table(found: Sequence[Json], file: str) -> None:
    """The world model and the actions inferred, on a file's transitions."""
    print(WITHOUT_SIMULATOR)
    print(" | ".join(("trained in", "draw", "labels", "seeds", "what", *GROUPS)))
    settings = dict.fromkeys((each["trained"], each["draw"], each["labels"]) for each in found)
    for trained, draw, labels in settings:
        same = [each for each in found if (each["trained"], each["draw"], each["labels"]) == (trained, draw, labels)]
        tests = [each["tests"][file] for each in same]
        rows = {"world_model": [test["all"]["world_model"] for test in tests]}
        rows |= {f"actions, {form}": [test["inferred"][form] for test in tests] for form in FORMS}
        for name, values in rows.items():
            cells = [_cell([each.get(group) for each in values]) for group in GROUPS]
            print(" | ".join((trained, draw, str(labels), str(len(tests)), name, *cells)))


def draw_charts(figures: Sequence[Name], found: Sequence[Json], out: Path) -> None:
    """A chart of each figure, overall and of interactions."""
    for figure, counted, group in _charts(figures):
        lines = dict[str, list[tuple[float, Estimate]]]()
        for predictor, draw, point in product(PREDICTORS, DRAWS, POINTS[figure]):
            tests = tests_at(found, point, draw)
            if predictor in predictors_of(tests, counted):
                value = _estimate(tests, counted, predictor, group)
                lines.setdefault(f"{predictor}, {draw}", []).append((point.x, value))
        if lines:
            file = "-".join((figure, *(["masked"] if counted == "masked" else []), group))
            charts.curves(lines, AXES[figure], f"Dynamics Accuracy, {group}", out / f"{file}.png")


def figures_of(figures: Sequence[Name], found: Sequence[Json]) -> list[Figure]:
    """Every predictor at each point from balanced labels, those of noise without the tiles; the target is sparse's."""
    told = []
    for figure, point in [(name, point) for name in figures for point in POINTS[name]]:
        counted, tests = COUNTED[figure][0], tests_at(found, point, "balanced")
        for predictor in ("world_model", *FORMS) if tests else ():
            mean = _estimate(tests, counted, predictor, "overall").mean
            goal = TARGET if predictor == TARGETED else None
            told.append(Figure(f"{figure}_{predictor}_{point.x}", mean, "share", goal))
    return told


def tests_at(found: Sequence[Json], point: Point, draw: Draw) -> list[Json]:
    """One a seed."""
    return [
        each["tests"][point.tested.name]
        for each in found
        if (each["draw"], each["labels"], each["trained"]) == (draw, point.labels, point.trained.name)
        and point.tested.name in each["tests"]
    ]


def predictors_of(tests: Sequence[Json], counted: str) -> list[str]:
    """Those that the tests tell of. Without the tiles another chance changes nothing, so it is left out there."""
    known = tests[0][counted] if tests else ()
    return [name for name in PREDICTORS if name in known and not (counted == "masked" and name.endswith(FRESH))]


def _charts(figures: Sequence[Name]) -> Iterator[tuple[Name, str, str]]:
    for figure in figures:
        yield from product([figure], COUNTED[figure], ("overall", "interaction"))


def _estimate(tests: Sequence[Json], counted: str, predictor: str, group: str) -> Estimate:
    return estimate([test[counted][predictor][group] for test in tests])


def _cell(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return str(estimate(known)) if known else ""
