"""Collection: a behavior runs in a simulator; its observations join the pool, its states go to the provenance store.

The actions are known only while the behavior runs. They are not stored, except as the labels that were asked for.
"""

import json
from collections.abc import Iterator
from contextlib import closing
from functools import partial

from api_schemas.collections import CollectionCreate
from api_schemas.environments import DEFAULT_BEHAVIORS, DiscreteActions
from api_schemas.labels import LabelSource, LabelsRequest
from service import labels, pool, projects
from service.errors import NoProvenance
from service.labels import LabeledUpload
from service.store import codec
from service.store.provenance import ProvenanceBlobs
from service.store.queries import pool as pool_queries
from service.store.tables import ProjectRow
from workers.behaviors import behavior_named
from workers.episodes import Episode, Quota, new_episodes
from workers.job import RunningJob
from workers.simulators.base import Behavior, Simulator
from workers.simulators.catalog import make_simulator

BATCH = 25  # trajectories a transaction


def run_collection(job: RunningJob, asked: CollectionCreate, provenance: ProvenanceBlobs | None) -> dict[str, object]:
    """Collect and store. The seed decides every episode, so a second run stores the same trajectories: nothing new."""
    if provenance is None:
        raise NoProvenance("of a collection")
    with job.worker.database.read() as session:
        project = projects.find(session, asked.project)
    environment = projects.environment_of(project)
    with closing(make_simulator(environment.simulator or "", environment.options)) as simulator:
        return _collect(job, project, asked, simulator, provenance)


def _collect(
    job: RunningJob,
    project: ProjectRow,
    asked: CollectionCreate,
    simulator: Simulator,
    provenance: ProvenanceBlobs,
) -> dict[str, object]:
    quota = _quota(project, asked, simulator)
    collected, done, batch = 0, 0, []
    behavior = behavior_named(_behavior(project, asked), simulator, partial(provenance.get, "policies"))
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
    return {"trajectories": collected, "transitions": done, "labels": dict(quota.taken), "short_of": quota.missing()}


def _new_episodes(
    job: RunningJob, project: ProjectRow, asked: CollectionCreate, simulator: Simulator, behavior: Behavior
) -> Iterator[Episode]:
    """Episodes that neither were drawn before nor are in the other split already."""

    def known(episode: Episode) -> bool:
        return _in_other_split(job, project, asked, codec.content_id(episode.observations))

    def tell(left: int, repeats: int) -> None:
        job.report(1 - left / asked.transitions, f"{repeats} episodes in a row were known before")

    return new_episodes(simulator, behavior, asked.transitions, asked.seed, known, tell, job.go_on)


def _behavior(project: ProjectRow, asked: CollectionCreate) -> str:
    return asked.behavior or DEFAULT_BEHAVIORS[projects.environment_of(project).simulator or ""]


def _quota(project: ProjectRow, asked: CollectionCreate, simulator: Simulator) -> Quota:
    space = projects.spaces_of(project).actions
    names = (space.names or tuple(map(str, range(space.n)))) if isinstance(space, DiscreteActions) else ()
    return Quota(simulator, names, asked.labels.per_action if asked.labels else 0)


def _in_other_split(job: RunningJob, project: ProjectRow, asked: CollectionCreate, identity: str) -> bool:
    with job.worker.database.read() as session:
        member = pool_queries.membership(session, project.id, identity)
    return member is not None and asked.split not in ("auto", member.split)


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
    request = LabelsRequest(project=project.id, source=LabelSource(kind="simulator", name=_behavior(project, asked)))
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
        "behavior": _behavior(project, asked),
        "seed": episode.seed,
        "generator": episode.generator,
    }
    data = codec.encode(episode.states, {"metadata": json.dumps(metadata)})
    return provenance.put("provenance", data)
