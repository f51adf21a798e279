"""Collection: a behavior runs in a simulator; its observations join the pool, its states go to the provenance store.

The actions are known only while the behavior runs. They are not stored, except as the labels that were asked for.
"""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from api_schemas.collections import CollectionCreate
from api_schemas.environments import DiscreteActions
from api_schemas.labels import LabelSource, LabelsRequest
from service import labels, pool, projects
from service.errors import NoProvenance
from service.labels import LabeledUpload
from service.store import codec
from service.store.provenance import ProvenanceBlobs
from service.store.queries import pool as pool_queries
from service.store.tables import ProjectRow
from workers.explanation import explain
from workers.job import RunningJob
from workers.simulators.base import Behavior, Simulator
from workers.simulators.catalog import make_behavior, make_simulator

BATCH = 25  # trajectories a transaction
REPEATS = 1000  # episodes in a row that were seen before: the simulator has nothing new to show


@dataclass(frozen=True)
class Episode:
    """Observations and states (T + 1, ...), and the T actions that led through them."""

    observations: dict[str, NDArray[Any]]
    states: dict[str, NDArray[Any]]
    actions: list[int]
    seed: int

    @property
    def transitions(self) -> int:
        """T."""
        return len(self.actions)


def run_collection(job: RunningJob, asked: CollectionCreate, provenance: ProvenanceBlobs | None) -> dict[str, object]:
    """Collect and store. The seed decides every episode, so a second run stores the same trajectories: nothing new."""
    if provenance is None:
        raise NoProvenance("of a collection")
    with job.worker.database.read() as session:
        project = projects.find(session, asked.project)
    environment = projects.environment_of(project)
    simulator = make_simulator(environment.simulator or "", environment.options)
    behavior = make_behavior(asked.behavior, simulator)
    quota = _Quota(project, asked, simulator)
    collected, done, batch = 0, 0, []
    for episode in _new_episodes(job, project, asked, simulator, behavior):
        batch.append((episode, quota.take(episode)))
        collected, done = collected + 1, done + episode.transitions
        job.report(min(1.0, done / asked.transitions), f"collected {done} of {asked.transitions} transitions")
        if len(batch) == BATCH:
            _store(job, project, asked, batch, provenance)
            batch = []
        if quota.met:
            break
    _store(job, project, asked, batch, provenance)
    simulator.close()
    return {"trajectories": collected, "transitions": done, "labels": dict(quota.taken), "short_of": quota.missing()}


def _new_episodes(
    job: RunningJob, project: ProjectRow, asked: CollectionCreate, simulator: Simulator, behavior: Behavior
) -> Iterator[Episode]:
    """Episodes of `asked.transitions` transitions in all; none twice, and none that the other split holds already."""
    rng = np.random.default_rng(asked.seed)
    seen: set[str] = set()
    left, repeats = asked.transitions, 0
    while left > 0 and repeats < REPEATS:
        episode = _episode(simulator, behavior, rng, left)
        identity = codec.content_id(episode.observations)
        if identity in seen or _in_other_split(job, project, asked, identity):
            repeats += 1
            job.report(1 - left / asked.transitions, f"{repeats} episodes in a row were known before")
            continue
        seen.add(identity)
        left, repeats = left - episode.transitions, 0
        yield episode


def _in_other_split(job: RunningJob, project: ProjectRow, asked: CollectionCreate, identity: str) -> bool:
    with job.worker.database.read() as session:
        member = pool_queries.membership(session, project.id, identity)
    return member is not None and asked.split not in ("auto", member.split)


class _Quota:
    """How many effective transitions of each action are still to be labeled.

    A transition is effective when its action alone explains it: what happens by itself, like a flickering tile, has
    every idle action as an explanation.
    """

    def __init__(self, project: ProjectRow, asked: CollectionCreate, simulator: Simulator) -> None:
        self._simulator = simulator
        self.per_action = asked.labels.per_action if asked.labels else 0
        space = projects.spaces_of(project).actions
        self.names = space.names if isinstance(space, DiscreteActions) else ()
        self.count = space.n if isinstance(space, DiscreteActions) else 0
        self.taken: Counter[str] = Counter()

    @property
    def met(self) -> bool:
        """Every action has its share; never true where no labels were asked for."""
        return self.per_action > 0 and not self.missing()

    def missing(self) -> dict[str, int]:
        """By action, how many transitions are still wanted."""
        short = {name: self.per_action - self.taken[name] for name in map(self._name, range(self.count))}
        return {name: number for name, number in short.items() if number > 0}

    def take(self, episode: Episode) -> list[int]:
        """Starts of the transitions of this episode to label: effective ones of actions that are still wanted."""
        starts = []
        for start, action in enumerate(episode.actions):
            name = self._name(action)
            if self.taken[name] < self.per_action and self._effective(episode, start):
                self.taken[name] += 1
                starts.append(start)
        return starts

    def _effective(self, episode: Episode, start: int) -> bool:
        state = {name: array[start] for name, array in episode.states.items()}
        observed = {name: stream[start + 1] for name, stream in episode.observations.items()}
        return explain(self._simulator, state, observed)[0] == [episode.actions[start]]

    def _name(self, action: int) -> str:
        return self.names[action] if self.names else str(action)


def _episode(simulator: Simulator, behavior: Behavior, rng: np.random.Generator, most: int) -> Episode:
    """The next episode, cut after `most` transitions so that a collection is as long as was asked for."""
    seed = int(rng.integers(2**31))
    observations, states = [simulator.reset(seed)], [simulator.state()]
    actions: list[int] = []
    behavior.reset(rng)
    while len(actions) < most:
        action = behavior.act(simulator, rng)
        step = simulator.step(action)
        observations.append(step.observation)
        states.append(simulator.state())
        actions.append(int(action))
        if step.terminated or step.truncated:
            break
    return Episode(_stacked(observations), _stacked(states), actions, seed)


def _stacked(steps: list[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """T + 1 dicts of arrays to one dict of arrays (T + 1, ...)."""
    return {name: np.stack([step[name] for step in steps]) for name in steps[0]}


def _store(
    job: RunningJob,
    project: ProjectRow,
    asked: CollectionCreate,
    batch: list[tuple[Episode, list[int]]],
    provenance: ProvenanceBlobs,
) -> None:
    """Blobs first, then the rows of the whole batch in one transaction."""
    spaces = projects.spaces_of(project)
    stored = []
    for episode, starts in batch:
        trajectory = pool.store(job.worker.blobs, spaces, episode.observations, f"episode {episode.seed}")
        stored.append((trajectory, _store_provenance(provenance, project, asked, episode), episode, starts))
        job.go_on()
    request = LabelsRequest(project=project.id, source=LabelSource(kind="simulator", name=asked.behavior))
    with job.transaction() as session:
        pool.keep(session, [trajectory for trajectory, *_ in stored], job.now())
        row = projects.find(session, project.id, lock=True)
        pool.add_all(session, row, [(trajectory, states) for trajectory, states, *_ in stored], asked.split, job.now())
        uploads = [
            LabeledUpload(trajectory, episode.actions, None, starts, asked.split)
            for trajectory, _, episode, starts in stored
            if starts
        ]
        if uploads:
            labels.accept(session, request, uploads, job.now, job.worker.settings.job_max_attempts)


def _store_provenance(
    provenance: ProvenanceBlobs, project: ProjectRow, asked: CollectionCreate, episode: Episode
) -> str:
    environment = projects.environment_of(project)
    metadata = {
        "simulator": environment.simulator,
        "options": environment.options,
        "behavior": asked.behavior,
        "seed": episode.seed,
    }
    data = codec.encode(episode.states, {"metadata": json.dumps(metadata)})
    return provenance.put("provenance", data)
