"""The figures of a model error that people look at: what they are called, and where each of them is found."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from api_schemas.rounds import ModelError, ModelErrorCurve, OpenLoopError

Value = Callable[[ModelError], float | None]


def _none(_: ModelError) -> None:
    return None


@dataclass(frozen=True)
class Measure:
    """One of them. value: None of an error that does not have it. percent: it is a share.

    unit: of what, or in what. still: the same of a prediction that nothing moves, where there is such a thing.
    """

    title: str
    unit: str
    value: Value
    percent: bool = False
    still: Value = _none

    def told(self, error: ModelError) -> str:
        """For a cell of a table."""
        still = self.still(error)
        return self._told(self.value(error)) + ("" if still is None else f" / {self._told(still)}")

    def _told(self, value: float | None) -> str:
        if value is None:
            return "-"
        return f"{value:.1%}" if self.percent else f"{value:.4f}"


NATS = Measure("test loss", "nats per transition", lambda error: None if error.open_loop else error.loss)
UNFORESEEN = Measure("not foreseen", "of what changes", lambda error: error.loss if error.open_loop else None, True)
ACCURACY = Measure("Dynamics Accuracy", "of what changes", lambda error: error.dynamics_accuracy, True)


def errors_of(curves: Mapping[str, ModelErrorCurve]) -> list[ModelError]:
    """Of all their points."""
    return [point.model_error for curve in curves.values() for point in curve.points]


def losses(errors: Iterable[ModelError]) -> list[Measure]:
    """What the loss of these errors is; that of grids where none has been measured."""
    errors = list(errors)
    return [each for each in (NATS, UNFORESEEN) if any(each.value(error) is not None for error in errors)] or [NATS]


def groups(errors: Iterable[ModelError]) -> list[Measure]:
    """Dynamics Accuracy by group of actions, movement first."""
    names = sorted({name for error in errors for name in error.by_group}, reverse=True)
    return [Measure(name, ACCURACY.unit, _of_group(name), True) for name in names]


def open_loop(errors: Iterable[ModelError]) -> list[Measure]:
    """Of robots: the error over whole segments, by stream."""
    ends = [error.open_loop[-1] for error in errors if error.open_loop]
    kinds = dict.fromkeys((stream, end.horizon) for end in ends for stream in end.errors)
    return [_of_stream(stream, horizon) for stream, horizon in kinds]


def _of_group(name: str) -> Value:
    return lambda error: error.by_group[name].dynamics_accuracy if name in error.by_group else None


def _of_stream(stream: str, horizon: int) -> Measure:
    def end(error: ModelError) -> OpenLoopError | None:
        return next((each for each in error.open_loop if each.horizon == horizon), None)

    def value(error: ModelError) -> float | None:
        found = end(error)
        return None if found is None else found.errors.get(stream)

    def still(error: ModelError) -> float | None:
        found = end(error)
        return None if found is None else found.standing_still.get(stream)

    return Measure(f"{stream}, {horizon} steps", "squared error", value, still=still)
