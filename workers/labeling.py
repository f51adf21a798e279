"""The labeling worker: a simulator answers an acquisition, over HTTP like any other labeler.

It restores the state in which a segment was observed and steps the simulator to find which actions reproduce what was
observed next. No stored action is read: none is stored.
"""

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from api_schemas.acquisitions import Acquisition, AcquisitionItem
from api_schemas.labels import LabelItem, LabelsAccepted, LabelSource, LabelsRequest
from asim.client import Client
from workers.simulators.base import Observation, Simulator, State
from workers.simulators.catalog import make_simulator

BATCH = 500  # labels a request
Progress = Callable[[int, int], None]


class UnexplainedStep(ValueError):
    """No action of the simulator leads from a segment's state to its next observation."""

    def __init__(self, item: AcquisitionItem, step: int, residual: float) -> None:
        super().__init__(
            f"segment {item.trajectory}:{item.start}, step {step}: no action reproduces the observation; "
            f"the nearest one is off by {residual:g}"
        )


def run_labeling(
    client: Client, acquisition: Acquisition, generator: np.random.Generator, progress: Progress | None = None
) -> LabelsAccepted:
    """Label all items of an acquisition and post them under its token. Raises UnexplainedStep and the client's errors.

    generator: where several actions explain a step, draws the one that the label names beside the whole set.
    """
    project = client.project(acquisition.project)
    environment = project.environment
    if environment.simulator is None:
        raise ValueError(f"project {project.id} names no simulator; its labels must come from elsewhere")
    simulator = make_simulator(environment.simulator, environment.options)
    accepted: LabelsAccepted | None = None
    labels: list[LabelItem] = []
    for done, item in enumerate(acquisition.items, 1):
        labels.append(_label(client, acquisition, simulator, item, generator))
        if progress is not None:
            progress(done, len(acquisition.items))
        if len(labels) == BATCH or done == len(acquisition.items):
            accepted = _joined(accepted, client.label(_request(acquisition, simulator, labels)))
            labels = []
    simulator.close()
    if accepted is None:
        raise ValueError(f"acquisition {acquisition.id} holds no items")
    return accepted


def explain(simulator: Simulator, state: State, observed: Observation) -> tuple[list[int], float]:
    """All discrete actions that lead from `state` to `observed`, and the residual of the best of them.

    The list is empty where even the best one misses; residual is the largest difference in any stream.
    """
    if not isinstance(simulator.action_space, gym.spaces.Discrete):
        raise ValueError(f"action space {simulator.action_space} cannot be tried action by action")
    residuals = [_residual(simulator, state, action, observed) for action in range(int(simulator.action_space.n))]
    return [action for action, residual in enumerate(residuals) if residual == 0.0], min(residuals)


def _label(
    client: Client,
    acquisition: Acquisition,
    simulator: Simulator,
    item: AcquisitionItem,
    generator: np.random.Generator,
) -> LabelItem:
    content = client.trajectory_content(acquisition.project, item.trajectory, item.start, item.length)
    states, _ = client.provenance(acquisition.project, item.trajectory, item.start, item.length)
    sets, worst = [], 0.0
    for step, (state, observed) in enumerate(_steps(states, content, item.length)):
        actions, residual = explain(simulator, state, observed)
        if not actions:
            raise UnexplainedStep(item, step, residual)
        sets.append(actions)
        worst = max(worst, residual)
    drawn = [int(generator.choice(actions)) for actions in sets]
    return LabelItem(
        trajectory=item.trajectory, start=item.start, actions=list(drawn), action_sets=sets, residual=worst
    )


def _steps(
    states: dict[str, NDArray[Any]], content: dict[str, NDArray[Any]], length: int
) -> Iterator[tuple[State, Observation]]:
    """(state before, observation after) of each of a segment's steps."""
    for step in range(length):
        yield {name: array[step] for name, array in states.items()}, {n: a[step + 1] for n, a in content.items()}


def _residual(simulator: Simulator, state: State, action: int, observed: Observation) -> float:
    simulator.restore(state)
    reached = simulator.step(action).observation
    return max(float(np.abs(reached[name].astype(np.float64) - observed[name]).max()) for name in observed)


def _request(acquisition: Acquisition, simulator: Simulator, labels: list[LabelItem]) -> LabelsRequest:
    return LabelsRequest(
        project=acquisition.project,
        acquisition=acquisition.id,
        token=acquisition.token,
        source=LabelSource(kind="simulator", name=type(simulator).__name__),
        items=labels,
    )


def _joined(before: LabelsAccepted | None, after: LabelsAccepted) -> LabelsAccepted:
    if before is None:
        return after
    return LabelsAccepted(
        receipts=[*before.receipts, *after.receipts],
        created=before.created + after.created,
        duplicates=before.duplicates + after.duplicates,
        watermark=after.watermark,
        round=after.round or before.round,
    )
