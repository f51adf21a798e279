"""The labeling worker: a simulator answers an acquisition, over HTTP like any other labeler.

It restores the state in which a segment was observed and steps the simulator to find which actions reproduce what was
observed next; or, to explore, executes there the actions that it is told. No stored action is read: none is stored.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from api_schemas.acquisitions import Acquisition, AcquisitionItem
from api_schemas.labels import Action, LabeledTrajectory, LabelItem, LabelsAccepted, LabelSource
from asim.arrays import pack
from asim.client import Client
from asim.errors import LeaseLost, ServiceError, Unavailable
from workers.delivery import Answer, Delivery
from workers.explanation import explain
from workers.simulators.base import Observation, Simulator, State
from workers.simulators.catalog import make_simulator

LONGEST_LEASE = 30 * 86400.0  # seconds that the service gives at once
Progress = Callable[[int, int], None]
Clock = Callable[[], datetime]


class UnexplainedStep(ValueError):
    """No action of the simulator leads from a segment's state to its next observation."""

    def __init__(self, item: AcquisitionItem, step: int, residual: float) -> None:
        super().__init__(
            f"segment {item.trajectory}:{item.start}, step {step}: no action reproduces the observation; "
            f"the nearest one is off by {residual:g}"
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
    before the error is raised. Raises UnexplainedStep and the client's errors, LeaseLost among them.
    """
    project = client.project(acquisition.project)
    environment = project.environment
    if environment.simulator is None:
        raise ValueError(f"project {project.id} names no simulator; its labels must come from elsewhere")
    if not acquisition.items:
        raise ValueError(f"acquisition {acquisition.id} holds no items")
    lease, answers = Lease(client, acquisition, clock), list[Answer]()
    refused: list[UnexplainedStep | ServiceError] = []
    with closing(make_simulator(environment.simulator, environment.options)) as simulator:
        for done, item in enumerate(acquisition.items, 1):
            lease.keep()
            try:
                answers.append(_answer(client, acquisition, simulator, item, generator))
            except Unavailable:
                raise  # that is not the item's fault: all of them can be answered later
            except (UnexplainedStep, ServiceError) as error:
                refused.append(error)
            if progress is not None:
                progress(done, len(acquisition.items))
        source = LabelSource(kind="simulator", name=type(simulator).__name__)
    delivery = Delivery(client, acquisition, source)
    delivery.hand_in(answers)
    refused += delivery.refused
    if refused:
        lease.give_back()
        raise _lost(refused, len(acquisition.items)) or refused[0]
    return delivery.receipt()


class Lease:
    """Keeps the lease of a batch that takes long to label: once half of what is left has passed, it is extended.

    clock: the time of day, which may differ from the service's by less than the lease.
    """

    def __init__(self, client: Client, acquisition: Acquisition, clock: Clock) -> None:
        self._client, self._acquisition, self._clock = client, acquisition, clock
        taken = acquisition.lease_expires_at - acquisition.created_at
        self._seconds = min(taken.total_seconds(), LONGEST_LEASE)  # as its taker wanted it, not the project's default
        self._half = self._half_way(acquisition)

    def keep(self) -> None:
        """Extend the lease where it is time to. Raises LeaseLost where nothing is left to answer under it."""
        token = self._acquisition.token
        if token is None or self._clock() < self._half:
            return
        try:
            self._half = self._half_way(self._client.extend(self._acquisition.id, token, self._seconds))
        except LeaseLost as error:
            if self._client.acquisition(self._acquisition.id).status != "labeled":  # else all is a duplicate, no loss
                raise _lost([error], len(self._acquisition.items)) or error from error

    def give_back(self) -> None:
        """Release what is not answered."""
        if self._acquisition.token is not None:
            with suppress(LeaseLost):  # there is nothing left that could be given back
                self._client.release(self._acquisition.id, self._acquisition.token)

    def _half_way(self, acquisition: Acquisition) -> datetime:
        now = self._clock()
        return now + (acquisition.lease_expires_at - now) / 2


def _lost(refused: Sequence[Exception], count: int) -> LeaseLost | None:
    """The lease's loss in a sentence, where that is why answers were refused."""
    lost = [error.problem for error in refused if isinstance(error, LeaseLost)]
    if not lost:
        return None
    detail = f"the lease was lost while its {count} items were answered: {lost[0].detail}"
    return LeaseLost(lost[0].model_copy(update={"detail": detail}))


def _answer(
    client: Client,
    acquisition: Acquisition,
    simulator: Simulator,
    item: AcquisitionItem,
    generator: np.random.Generator,
) -> Answer:
    if item.actions is not None:
        return _explore(client, acquisition, simulator, item, item.actions)
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
    client: Client, acquisition: Acquisition, simulator: Simulator, item: AcquisitionItem, actions: Sequence[Action]
) -> LabeledTrajectory:
    """What is observed when the actions are executed from the item's observation on, up to the episode's end."""
    states, _ = client.provenance(acquisition.project, item.trajectory, item.start, 1)
    simulator.restore({name: array[0] for name, array in states.items()})
    before, seen = list[State](), [simulator.observe()]
    for action in actions:
        before.append(simulator.state())
        step = simulator.step(action if isinstance(action, int) else np.asarray(action))
        seen.append(step.observation)
        if step.terminated or step.truncated:
            break
    executed = list(actions[: len(before)])
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
