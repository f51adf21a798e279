"""The labeling worker: a simulator answers an acquisition, over HTTP like any other labeler.

It restores the state in which a segment was observed and steps the simulator to find which actions reproduce what was
observed next; or, to explore, executes there the actions that it is told. No stored action is read: none is stored.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from api_schemas.acquisitions import Acquisition, AcquisitionItem
from api_schemas.labels import Action, LabeledTrajectory, LabelItem, LabelsAccepted, LabelSource
from api_schemas.projects import Project
from asim.arrays import pack
from asim.client import Client
from asim.errors import ServiceError, Unavailable
from workers.delivery import Answer, Delivery
from workers.explanation import explain
from workers.lease import Clock, Lease, lost
from workers.simulators.base import Observation, Simulator, State
from workers.simulators.catalog import make_simulator

Progress = Callable[[int, int], None]
NOTES = 10  # of what was refused, told besides the first


class UnanswerableItem(ValueError):
    """The simulator has no answer to an item."""


class UnexplainedStep(UnanswerableItem):
    """No action of the simulator leads from a segment's state to its next observation."""

    def __init__(self, item: AcquisitionItem, step: int, residual: float) -> None:
        super().__init__(
            f"segment {item.trajectory}:{item.start}, step {step}: no action reproduces the observation; "
            f"the nearest one is off by {residual:g}"
        )


class EndedEarly(UnanswerableItem):
    """An exploration's episode ended before it was a segment long."""

    def __init__(self, item: AcquisitionItem, executed: int, needed: int) -> None:
        super().__init__(
            f"item {item.rank}, explored from {item.trajectory}:{item.start}: the episode ended after {executed} "
            f"transitions, a segment of this project needs {needed}"
        )


def run_labeling(
    client: Client,
    acquisition: Acquisition,
    generator: np.random.Generator,
    progress: Progress | None = None,
    clock: Clock = lambda: datetime.now(UTC),
) -> LabelsAccepted:
    """Label the items of an acquisition and post them under its token; a lease that runs short is extended.

    generator: where several actions explain a step, draws the one that the label names beside the whole set.
    Where an item cannot be labeled, or its answer is refused, the others are posted all the same and it is given back
    before the error is raised. Raises UnanswerableItem and the client's errors, LeaseLost among them;
    where several items were refused, that of the first, which bears the others as notes.
    """
    project = client.project(acquisition.project)
    environment = project.environment
    if environment.simulator is None:
        raise ValueError(f"project {project.id} names no simulator; its labels must come from elsewhere")
    if not acquisition.items:
        raise ValueError(f"acquisition {acquisition.id} holds no items")
    lease, answers = Lease(client, acquisition, clock), list[Answer]()
    refused: list[UnanswerableItem | ServiceError] = []
    with closing(make_simulator(environment.simulator, environment.options)) as simulator:
        for done, item in enumerate(acquisition.items, 1):
            lease.keep()
            try:
                answers.append(_answer(client, project, acquisition, simulator, item, generator))
            except Unavailable:
                raise  # that is not the item's fault: all of them can be answered later
            except (UnanswerableItem, ServiceError) as error:
                refused.append(error)
            if progress is not None:
                progress(done, len(acquisition.items))
        source = LabelSource(kind="simulator", name=type(simulator).__name__)
    delivery = Delivery(client, acquisition, source, lease.holds)
    delivery.hand_in(answers)
    refused += delivery.refused
    if refused:
        lease.give_back()
        raise lost(refused, len(acquisition.items)) or _first(refused)
    return delivery.receipt()


def _first(refused: Sequence[Exception]) -> Exception:
    for other in refused[1:NOTES]:
        refused[0].add_note(f"and {other}")
    if len(refused) > NOTES:
        refused[0].add_note(f"and {len(refused) - NOTES} more")
    return refused[0]


def _answer(
    client: Client,
    project: Project,
    acquisition: Acquisition,
    simulator: Simulator,
    item: AcquisitionItem,
    generator: np.random.Generator,
) -> Answer:
    if item.actions is not None:
        return _explore(client, project, simulator, item, item.actions)
    return _label(client, acquisition, simulator, item, generator)


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


def _explore(
    client: Client, project: Project, simulator: Simulator, item: AcquisitionItem, actions: Sequence[Action]
) -> LabeledTrajectory:
    """What is observed when the actions are executed from the item's observation on, up to the episode's end."""
    states, _ = client.provenance(project.id, item.trajectory, item.start, 1)
    simulator.restore({name: array[0] for name, array in states.items()})
    before, seen = list[State](), [simulator.observe()]
    for action in actions:
        before.append(simulator.state())
        step = simulator.step(action if isinstance(action, int) else np.asarray(action))
        seen.append(step.observation)
        if step.terminated or step.truncated:
            break
    executed = list(actions[: len(before)])
    if len(executed) < project.segment_length:  # the service would refuse it, and with it the request that it is in
        raise EndedEarly(item, len(executed), project.segment_length)
    sets = []
    for number, (state, observed, action) in enumerate(zip(before, seen[1:], executed, strict=True)):
        explaining, residual = explain(simulator, state, observed)
        if action not in explaining:  # the simulator does not repeat itself
            raise UnexplainedStep(item, number, residual)
        sets.append(explaining)
    content = pack({name: np.stack([each[name] for each in seen]) for name in seen[0]})
    # Base64Bytes is given encoded bytes and holds decoded ones: constructing skips that round trip.
    return LabeledTrajectory.model_construct(
        content=content, actions=executed, action_sets=sets, split="pool", rank=item.rank
    )


def _steps(
    states: dict[str, NDArray[Any]], content: dict[str, NDArray[Any]], length: int
) -> Iterator[tuple[State, Observation]]:
    """(state before, observation after) of each of a segment's steps."""
    for step in range(length):
        yield {name: array[step] for name, array in states.items()}, {n: a[step + 1] for n, a in content.items()}
