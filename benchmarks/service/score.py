"""The scoring job beside the networks' bare forward pass, one thread each, in one run.

The job is what a worker does: claim, rows, blobs, decoding, cycle scores, storing, and the merge that selects the
queue. The bare pass is the same networks on the same segments, tensors already in memory: the inverse dynamics infers,
the world model encodes, predicts and decodes, and nothing is compared. Torch has one thread in both; the job reads its
next segments ahead in a second thread, as a worker does. Both alternate; ratios are of medians.
"""

import gc
import statistics
import tempfile
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from uuid import UUID

import torch

from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.environments import Environment
from api_schemas.projects import LabelingPolicy, ProjectCreate
from benchmarks.figures import Figure, finish
from models.acquisition.base import CHUNK, Models
from models.segments import SegmentBatch, first
from service import collections, projects, rounds, scorings
from service.clock import utc_now
from service.settings import Settings
from service.store.database import migrate
from service.store.queries import pool as pool_queries
from service.store.queries import rounds as round_queries
from workers import data
from workers.dispatch import open_worker, run_next
from workers.job import Worker
from workers.runner import prepare_science
from workers.scoring import load_models

TRANSITIONS, LABELS_PER_ACTION, REPEATS = 28_000, 30, 9


def main() -> None:
    """Run and print."""
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(data_folder=Path(folder), torch_threads=1)
        prepare_science(settings)
        migrate(settings.resolved_database_url())
        worker = open_worker(settings, utc_now, ("label", "train", "score"))
        project_id = _prepare(worker, utc_now())
        models, batch = _loaded(worker, project_id)
        gc.freeze()  # the bare pass's tensors and names are no garbage either, and no worker holds them
        shard, merge, bare = [], [], []
        for _ in range(REPEATS):
            bare.append(_seconds(lambda: _forward(models, batch)))
            _request_scoring(worker, project_id)
            shard.append(_seconds(lambda: run_next(worker)))
            merge.append(_seconds(lambda: run_next(worker)))
        worker.database.close()
    _report(batch.size, shard, merge, bare)


def _report(size: int, shard: list[float], merge: list[float], bare: list[float]) -> None:
    whole = [a + b for a, b in zip(shard, merge, strict=True)]
    print(f"{size} segments, {REPEATS} repeats, torch threads {torch.get_num_threads()}, {CHUNK} segments a pass")
    for name, seconds in (("score_shard", shard), ("merge_scores", merge), ("bare pass", bare)):
        print(f"  {name}: {', '.join(f'{value:.2f}' for value in seconds)} s")
    finish(
        [
            Figure("bare_pass", size / statistics.median(bare), "transitions/s"),
            Figure("scoring_job", size / statistics.median(shard), "transitions/s"),
            Figure("scoring_job_with_selection", size / statistics.median(whole), "transitions/s"),
            Figure("scoring_job_to_bare_pass", statistics.median(bare) / statistics.median(shard), "ratio", 0.70),
        ]
    )


def _prepare(worker: Worker, now: datetime) -> UUID:
    """A project with its pool, some labels and one trained round."""
    request = ProjectCreate(
        name="bench", environment=Environment(simulator="minigrid"), policy=LabelingPolicy(round_labels=0)
    )
    labels = CollectionLabels(per_action=LABELS_PER_ACTION)
    with worker.database.write() as session:
        project = projects.create(session, request, now)
    for asked in (
        CollectionCreate(
            project=project.id, behavior="balanced", transitions=5_000, seed=1, split="pool", labels=labels
        ),
        CollectionCreate(project=project.id, transitions=TRANSITIONS, split="pool"),
    ):
        with worker.database.write() as session:
            collections.request(session, asked, now)
        run_next(worker)
    with worker.database.write() as session:
        round_id = rounds.request(session, projects.find(session, project.id, lock=True), now).id
    while _status(worker, round_id) != "current":  # the subgoal generator's job has a lower priority and waits
        if not run_next(worker):
            raise RuntimeError(f"round {round_id} is {_status(worker, round_id)} and no job waits")
    return project.id


def _status(worker: Worker, round_id: UUID) -> str:
    with worker.database.read() as session:
        return rounds.find(session, round_id).status


def _request_scoring(worker: Worker, project_id: UUID) -> None:
    """The job that a new round would ask for: the same networks, all segments, nothing kept from the last time."""
    limits = scorings.limits_of(worker.settings)
    with worker.database.write() as session:
        current = round_queries.current_round(session, project_id)
        scorings.start(session, projects.find(session, project_id), "cycle", current, worker.clock(), limits)


def _loaded(worker: Worker, project_id: UUID) -> tuple[Models, SegmentBatch]:
    """The round's networks and all segments in memory."""
    with worker.database.read() as session:
        project = projects.find(session, project_id)
        current = round_queries.current_round(session, project_id)
        members = pool_queries.memberships(session, project_id, "pool")
        windows = data.windows_of(session, project, members, None)
    models = load_models(
        worker.database, worker.blobs, project, current.id if current else None, scorings.NEEDS["cycle"]
    )
    return models, data.load(worker.blobs, windows, project.segment_length)


@torch.inference_mode()
def _forward(models: Models, batch: SegmentBatch) -> None:
    if models.inverse_dynamics is None or models.world_model is None:
        raise RuntimeError("the round trained no inverse dynamics or no world model")
    for start in range(0, batch.size, CHUNK):
        observations = batch.take(slice(start, start + CHUNK)).observations
        actions = models.inverse_dynamics.infer(observations)
        state = models.world_model.infer_state(first(observations))
        prediction = models.world_model.rollout(state, actions)
        models.world_model.decode(prediction.flatten(0, 1))  # (B, L, ...) -> (B*L, ...)


def _seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
