"""How every benchmark ends: lines `name value unit (target ...)`, and exit status 1 where a target is missed."""

import sys
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Figure:
    """A measured value; `target` None is for the record only."""

    name: str
    value: float
    unit: str
    target: float | None = None
    better: Literal["below", "above"] = "above"

    @property
    def met(self) -> bool:
        """True where the target holds, or there is none."""
        if self.target is None:
            return True
        return self.value < self.target if self.better == "below" else self.value >= self.target

    def line(self) -> str:
        """The figure as it is printed."""
        goal = "" if self.target is None else f" (target {'<' if self.better == 'below' else '>='} {self.target:g})"
        return f"{self.name} {self.value:.4g} {self.unit}{goal}" + ("" if self.met else "  MISSED")


def finish(figures: list[Figure]) -> None:
    """Print all figures and end the process."""
    for figure in figures:
        print(figure.line())
    sys.exit(0 if all(figure.met for figure in figures) else 1)
