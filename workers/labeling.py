"""The labeling worker: a simulator answers an acquisition, over HTTP like any other labeler.

It restores the state in which a segment was observed and steps the simulator to find which actions reproduce what was
observed next. No stored action is read: none is stored.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from api_schemas.acquisitions import Acquisition, AcquisitionItem
from api_schemas.labels import LabelItem, LabelsAccepted, LabelSource, LabelsRequest
from asim.client import Client
from asim.errors import ServiceError
from workers.explanation import explain
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
    """Label the items of an acquisition and post them under its token.

    generator: where several actions explain a step, draws the one that the label names beside the whole set.
    Where an item cannot be labeled, the others are posted all the same and its segment is given back before the error
    is raised. Raises UnexplainedStep and the client's errors.
    """
    project = client.project(acquisition.project)
    environment = project.environment
    if environment.simulator is None:
        raise ValueError(f"project {project.id} names no simulator; its labels must come from elsewhere")
    if not acquisition.items:
        raise ValueError(f"acquisition {acquisition.id} holds no items")
    simulator = make_simulator(environment.simulator, environment.options)
    labels: list[LabelItem] = []
    refused: list[UnexplainedStep | ServiceError] = []
    for done, item in enumerate(acquisition.items, 1):
        try:
            labels.append(_label(client, acquisition, simulator, item, generator))
        except (UnexplainedStep, ServiceError) as error:
            refused.append(error)
        if progress is not None:
            progress(done, len(acquisition.items))
    accepted = [
        client.label(_request(acquisition, simulator, labels[first : first + BATCH]))
        for first in range(0, len(labels), BATCH)
    ]
    simulator.close()
    if refused:
        if acquisition.token is not None:
            client.release(acquisition.id, acquisition.token)
        raise refused[0]
    return functools.reduce(_joined, accepted)


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


def _request(acquisition: Acquisition, simulator: Simulator, labels: list[LabelItem]) -> LabelsRequest:
    return LabelsRequest(
        project=acquisition.project,
        acquisition=acquisition.id,
        token=acquisition.token,
        source=LabelSource(kind="simulator", name=type(simulator).__name__),
        items=labels,
    )


def _joined(before: LabelsAccepted, after: LabelsAccepted) -> LabelsAccepted:
    return LabelsAccepted(
        receipts=[*before.receipts, *after.receipts],
        created=before.created + after.created,
        duplicates=before.duplicates + after.duplicates,
        watermark=after.watermark,
        round=after.round or before.round,
    )
