"""Answering: what a simulator says to the items of an acquisition."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from typing import Any, Protocol

import numpy as np

from api_schemas.acquisitions import AcquisitionItem
from api_schemas.labels import Action, LabeledTrajectory, LabelItem
from api_schemas.projects import Project
from asim.arrays import pack
from asim.client import Client
from asim.errors import NotFound
from workers.delivery import Answer
from workers.explainers import Explainer, explainer_of
from workers.recording import Known, Provenance, Recording, stacked
from workers.replay import Behaviors
from workers.simulators.base import Simulator, SimulatorError
from workers.simulators.catalog import make_behavior, make_simulator
from workers.unanswerable import EndedEarly, SimulatorFailed, UnexplainedStep

KNOWN = 200  # labels that a search's first guesses are fitted on


class Answerer(Protocol):
    """Answers items, in this process or in another. `name` is the simulator's."""

    @property
    def name(self) -> str:
        """As labels tell their source."""

    def answer(self, item: AcquisitionItem, generator: np.random.Generator) -> Answer:
        """The answer to one item. generator: where several actions explain a step, draws the one that the label names
        beside the whole set. Raises UnanswerableItem and the client's errors."""

    def close(self) -> None:
        """Free the simulator."""


class SimulatorAnswerer:
    """Answers in a simulator of this process."""

    def __init__(self, client: Client, project: Project, behaviors: Behaviors = make_behavior) -> None:
        """behaviors: those that provenance tells of; by default the simulator's own, and labels of policies are
        searched. Raises ValueError where the project names no simulator, and what `make_simulator` does."""
        environment = project.environment
        if environment.simulator is None:
            raise ValueError(f"project {project.id} names no simulator; its labels must come from elsewhere")
        self._client, self._project = client, project
        self._simulator = make_simulator(environment.simulator, environment.options)
        self._explainer = _explainer(client, project, self._simulator, behaviors)

    @property
    def name(self) -> str:
        """The simulator's class."""
        return type(self._simulator).__name__

    def answer(self, item: AcquisitionItem, generator: np.random.Generator) -> Answer:
        """A label, or a trajectory where the item tells what to execute."""
        try:
            if item.actions is not None:
                return _explore(self._client, self._project, self._simulator, self._explainer, item, item.actions)
            return _label(self._client, self._project, self._explainer, item, generator)
        except SimulatorError as error:
            raise SimulatorFailed(item, error) from error

    def close(self) -> None:
        """Close it."""
        self._simulator.close()


def _explainer(client: Client, project: Project, simulator: Simulator, behaviors: Behaviors) -> Explainer:
    def provenance(trajectory: str) -> Provenance:
        return Provenance(*client.provenance(project.id, trajectory))

    def known() -> Iterator[Known]:
        for label in islice(client.labels(project.id), KNOWN):
            with suppress(NotFound):  # of the states of recordings that came from elsewhere
                yield Known(recording_of(client, project, label.trajectory, label.start), label.actions)

    return explainer_of(simulator, provenance, known, behaviors)


def recording_of(client: Client, project: Project, trajectory: str, start: int) -> Recording:
    """A segment with the states that it was recorded in. Raises NotFound where none are kept."""
    content = client.trajectory_content(project.id, trajectory, start, project.segment_length)
    states, _ = client.provenance(project.id, trajectory, start, project.segment_length)
    return Recording(trajectory, start, content, states)


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
    recording = Recording(item.trajectory, item.start, stacked(seen), stacked(passed))
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
