"""Why an item of an acquisition is given back unanswered."""

from api_schemas.acquisitions import AcquisitionItem
from workers.explainers import Explained
from workers.simulators.base import SimulatorError


class UnanswerableItem(ValueError):
    """The simulator has no answer to an item."""


class UnexplainedStep(UnanswerableItem):
    """No action of the simulator leads from a segment's state to its next observation."""

    def __init__(self, item: AcquisitionItem, step: int, found: Explained) -> None:
        allowed = f", {found.tolerance:g} is allowed" if found.tolerance else ""
        super().__init__(
            f"segment {item.trajectory}:{item.start}, step {step}: no action reproduces the observation; "
            f"the nearest one is off by {found.residual:g}{allowed}"
        )


class SimulatorFailed(UnanswerableItem):
    """The simulator refused an item's state, or broke down on it."""

    def __init__(self, item: AcquisitionItem, error: SimulatorError) -> None:
        super().__init__(f"segment {item.trajectory}:{item.start}: {error}")


class EndedEarly(UnanswerableItem):
    """An exploration's episode ended before it was a segment long."""

    def __init__(self, item: AcquisitionItem, executed: int, needed: int) -> None:
        super().__init__(
            f"item {item.rank}, explored from {item.trajectory}:{item.start}: the episode ended after {executed} "
            f"transitions, a segment of this project needs {needed}"
        )


class ProcessEnded(UnanswerableItem):
    """An item hung or crashed the simulator, or was not tried after others that did."""

    def __init__(self, item: AcquisitionItem, what: str) -> None:
        super().__init__(f"segment {item.trajectory}:{item.start} {what}")
