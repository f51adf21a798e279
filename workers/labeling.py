"""The labeling worker: a simulator answers an acquisition, over HTTP like any other labeler.

It restores the state in which a segment was observed and steps the simulator to find which actions reproduce what was
observed next (how: `explainers`); or, to explore, executes there the actions that it is told. No stored action is read:
none is stored.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from datetime import UTC, datetime
from itertools import islice
from typing import Any

import numpy as np

from api_schemas.acquisitions import Acquisition, AcquisitionItem
from api_schemas.labels import Action, LabeledTrajectory, LabelItem, LabelsAccepted, LabelSource
from api_schemas.projects import Project
from asim.arrays import pack
from asim.client import Client
from asim.errors import NotFound, ServiceError, Unavailable
from workers.delivery import Answer, Delivery
from workers.explainers import Explainer, explainer_of
from workers.lease import Clock, Lease, lost
from workers.recording import Arrays, Known, Provenance, Recording
from workers.simulators.base import Observation, Simulator, SimulatorError, State
from workers.simulators.catalog import make_simulator
from workers.unanswerable import EndedEarly, SimulatorFailed, UnanswerableItem, UnexplainedStep

Progress = Callable[[int, int], None]
NOTES = 10  # of what was refused, told besides the first
KNOWN = 200  # labels that a search's first guesses are fitted on


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
        explainer = _explainer(client, project, simulator)
        for done, item in enumerate(acquisition.items, 1):
            lease.keep()
            try:
                answers.append(_answer(client, project, simulator, explainer, item, generator))
            except Unavailable:
                raise  # that is not the item's fault: all of them can be answered later
            except (UnanswerableItem, ServiceError) as error:
                refused.append(error)
            except SimulatorError as error:
                refused.append(SimulatorFailed(item, error))
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


def _explainer(client: Client, project: Project, simulator: Simulator) -> Explainer:
    def provenance(trajectory: str) -> Provenance:
        return Provenance(*client.provenance(project.id, trajectory))

    def known() -> Iterator[Known]:
        for label in islice(client.labels(project.id), KNOWN):
            with suppress(NotFound):  # of the states of recordings that came from elsewhere
                yield Known(recording_of(client, project, label.trajectory, label.start), label.actions)

    return explainer_of(simulator, provenance, known)


def recording_of(client: Client, project: Project, trajectory: str, start: int) -> Recording:
    """A segment with the states that it was recorded in. Raises NotFound where none are kept."""
    content = client.trajectory_content(project.id, trajectory, start, project.segment_length)
    states, _ = client.provenance(project.id, trajectory, start, project.segment_length)
    return Recording(trajectory, start, content, states)


def _answer(
    client: Client,
    project: Project,
    simulator: Simulator,
    explainer: Explainer,
    item: AcquisitionItem,
    generator: np.random.Generator,
) -> Answer:
    if item.actions is not None:
        return _explore(client, project, simulator, explainer, item, item.actions)
    return _label(client, project, explainer, item, generator)


def _label(
    client: Client, project: Project, explainer: Explainer, item: AcquisitionItem, generator: np.random.Generator
) -> LabelItem:
    recording = recording_of(client, project, item.trajectory, item.start)
    sets, worst = list[list[Action]](), 0.0
    for step in range(item.length):
        found = explainer.explain(recording, step)
        if not found.actions:
            raise UnexplainedStep(item, step, found)
        sets.append(found.actions)
        worst = max(worst, found.residual)
    return LabelItem(
        trajectory=item.trajectory,
        start=item.start,
        actions=[actions[int(generator.integers(len(actions)))] for actions in sets],
        action_sets=_action_sets(explainer, sets),
        residual=worst,
    )


def _explore(
    client: Client,
    project: Project,
    simulator: Simulator,
    explainer: Explainer,
    item: AcquisitionItem,
    actions: Sequence[Action],
) -> LabeledTrajectory:
    """What is observed when the actions are executed from the item's observation on, up to the episode's end."""
    states, _ = client.provenance(project.id, item.trajectory, item.start, 1)
    simulator.restore({name: array[0] for name, array in states.items()})
    passed, seen = [simulator.state()], [simulator.observe()]
    for action in actions:
        step = simulator.step(action if isinstance(action, int) else np.asarray(action))
        passed.append(simulator.state())
        seen.append(step.observation)
        if step.terminated or step.truncated:
            break
    executed = list(actions[: len(seen) - 1])
    if len(executed) < project.segment_length:  # the service would refuse it, and with it the request that it is in
        raise EndedEarly(item, len(executed), project.segment_length)
    recording = Recording(item.trajectory, item.start, _stacked(seen), _stacked(passed))
    sets = []
    for number, action in enumerate(executed):
        found = explainer.confirm(recording, number, action)
        if not found.actions:  # the simulator does not repeat itself
            raise UnexplainedStep(item, number, found)
        sets.append(found.actions)
    # Base64Bytes is given encoded bytes and holds decoded ones: constructing skips that round trip.
    return LabeledTrajectory.model_construct(
        content=pack(recording.observations),
        actions=executed,
        action_sets=_action_sets(explainer, sets),
        split="pool",
        rank=item.rank,
    )


def _action_sets(explainer: Explainer, sets: Sequence[list[Any]]) -> list[list[int]] | None:
    """Only where they hold all actions that explain a step."""
    return list(sets) if explainer.is_exhaustive else None


def _stacked(steps: Sequence[Observation | State]) -> Arrays:
    return {name: np.stack([step[name] for step in steps]) for name in steps[0]}
