"""Collection: a behavior runs in a simulator; its observations join the pool, its states go to the provenance store.

The actions are known only while the behavior runs. They are not stored, except as the labels that were asked for.
"""

import json
import time
from collections.abc import Iterator
from contextlib import closing
from functools import partial

from api_schemas.collections import CollectionCreate
from api_schemas.environments import DEFAULT_BEHAVIORS, DiscreteActions
from api_schemas.jobs import Collect
from api_schemas.labels import LabelSource, LabelsRequest
from service import labels, pool, projects
from service.labels import LabeledUpload
from service.pool import NoProvenance
from service.store import codec
from service.store.provenance import ProvenanceBlobs
from service.store.queries import pool as pool_queries
from service.store.tables import ProjectRow
from workers.behaviors import behavior_named
from workers.collection_record import CollectionRecord
from workers.episodes import Episode, Extent, further_episodes
from workers.job import RunningJob
from workers.quotas import Quota, quota_of
from workers.simulators.base import Behavior, Simulator
from workers.simulators.catalog import make_simulator
from workers.standing import Standing

BATCH = 25  # trajectories a transaction at most
BATCH_SECONDS = 10.0  # after which it is stored with fewer: a robot's take a minute
Batch = list[tuple[Episode, list[int]]]  # with the starts of the segments to label


def run_collection(job: RunningJob, asked: Collect, provenance: ProvenanceBlobs | None) -> dict[str, object]:
    """Collect and store. The seed decides every episode, and where the collection stands is stored with each batch: an
    attempt goes on behind the last one, and a second run stores the same trajectories, nothing new."""
    if provenance is None:
        raise NoProvenance("of a collection")
    with job.worker.database.read() as session:
        project = projects.find(session, asked.collection.project)
    environment = projects.environment_of(project)
    with closing(make_simulator(environment.simulator or "", environment.options)) as simulator:
        return _collect(job, project, asked, simulator, provenance)


def _collect(
    job: RunningJob, project: ProjectRow, asked: Collect, simulator: Simulator, provenance: ProvenanceBlobs
) -> dict[str, object]:
    record = CollectionRecord(job, asked)
    standing = record.standing
    quota = _quota(project, asked.collection, simulator)
    quota.taken = standing.labels
    behavior = behavior_named(_behavior(project, asked.collection), simulator, partial(provenance.get, "policies"))
    episodes = _new_episodes(job, project, asked.collection, simulator, behavior, standing)
    while not quota.met and (batch := _next_batch(job, asked.collection, episodes, quota, standing)):
        _store(job, project, asked.collection, batch, provenance, record, quota)
    record.close()
    return record.result(quota)


def _next_batch(
    job: RunningJob, asked: CollectionCreate, episodes: Iterator[Episode], quota: Quota, standing: Standing
) -> Batch:
    """What is stored in one transaction; nothing where there is nothing new any more."""
    batch, began, extent = Batch(), time.monotonic(), extent_of(asked)
    for episode in episodes:
        batch.append((episode, quota.take(episode)))
        job.report(min(1.0, extent.share(standing.drawn)), f"collected {extent.told(standing.drawn)}")
        if len(batch) == BATCH or time.monotonic() - began > BATCH_SECONDS or quota.met:
            break
    return batch


def _new_episodes(
    job: RunningJob,
    project: ProjectRow,
    asked: CollectionCreate,
    simulator: Simulator,
    behavior: Behavior,
    standing: Standing,
) -> Iterator[Episode]:
    """Episodes that neither were drawn before nor are in the other split already."""
    standing.follow(behavior)
    extent, drawn = extent_of(asked), standing.drawn

    def known(episode: Episode) -> bool:
        return _in_other_split(job, project, asked, codec.content_id(episode.observations))

    def tell(repeats: int) -> None:
        job.report(extent.share(drawn), f"{repeats} episodes in a row were known before")

    return further_episodes(simulator, behavior, extent, drawn, known, tell, job.go_on)


def extent_of(asked: CollectionCreate) -> Extent:
    """How much is to be collected."""
    return Extent(asked.transitions, asked.trajectories)


def _behavior(project: ProjectRow, asked: CollectionCreate) -> str:
    return asked.behavior or DEFAULT_BEHAVIORS[projects.environment_of(project).simulator or ""]


def _quota(project: ProjectRow, asked: CollectionCreate, simulator: Simulator) -> Quota:
    space = projects.spaces_of(project).actions
    names = (space.names or tuple(map(str, range(space.n)))) if isinstance(space, DiscreteActions) else ()
    return quota_of(asked.labels, simulator, names, project.segment_length, project.stride)


def _in_other_split(job: RunningJob, project: ProjectRow, asked: CollectionCreate, identity: str) -> bool:
    with job.worker.database.read() as session:
        member = pool_queries.membership(session, project.id, identity)
    return member is not None and asked.split not in ("auto", member.split)


def _store(
    job: RunningJob,
    project: ProjectRow,
    asked: CollectionCreate,
    batch: Batch,
    provenance: ProvenanceBlobs,
    record: CollectionRecord,
    quota: Quota,
) -> None:
    """Blobs first, then the rows of the whole batch, and where the collection stands behind it, in one transaction."""
    spaces = projects.spaces_of(project)
    stored = []
    for episode, starts in batch:
        trajectory = pool.store(job.worker.blobs, spaces, episode.observations, f"episode {episode.seed}")
        stored.append((trajectory, _store_provenance(provenance, project, asked, episode), episode, starts))
        job.go_on()
    request = LabelsRequest(project=project.id, source=LabelSource(kind="simulator", name=_behavior(project, asked)))
    with record.batch(quota) as (session, found):
        pool.keep(session, [trajectory for trajectory, *_ in stored], job.now())
        row = projects.find(session, project.id, lock=True)
        members = [(trajectory, states) for trajectory, states, *_ in stored]
        found.extend(pool.add_all(session, row, members, asked.split, job.now()))
        uploads = [
            LabeledUpload(trajectory, episode.told_actions(), None, starts, asked.split)
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
