"""Two score workers share a pool: nearly twice as fast as one, with the same scores."""

import signal
import statistics
import time
from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

import pytest
from sqlalchemy import select

from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.projects import Project
from benchmarks.service.filling import fill, project_of
from service import projects, scorings
from service.clock import utc_now
from service.settings import Settings
from service.store.queries import jobs as job_queries
from service.store.queries import rounds as round_queries
from service.store.tables import EventRow, JobRow, QueueRow
from tests.crash.deployment import Deployment
from tests.figures import Figures
from tests.loop.processes import eventually
from tests.scale.conftest import Deploy

POOL, TRANSITIONS, SHARD = 600_000, 2500, 37_500  # segments; of a trajectory; segments of a shard
LABELS_PER_ACTION = 2
REPEATS, TARGET = 3, 1.7
LOOK_SECONDS = 0.5
COLLECT_SECONDS, ROUND_SECONDS, SCORE_SECONDS = 120.0, 180.0, 300.0


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_two_scorers_take_little_more_than_half_the_time_of_one(deploy: Deploy, figures: Figures) -> None:
    deployment = deploy(ASIM_SHARD_TRANSITIONS=str(SHARD), ASIM_TORCH_THREADS="1")
    deployment.start_worker("score")
    project = _trained(deployment)
    fill(deployment.client, project, POOL, TRANSITIONS)
    scored = deployment.client.project(project.id).counts.pool_segments
    _score(deployment, project.id)  # both ways begin with networks and files that were read once
    alone = [_score(deployment, project.id) for _ in range(REPEATS)]
    deployment.start_worker("score")
    _await_both(deployment, project.id)
    shared = [_score(deployment, project.id) for _ in range(REPEATS)]

    one, two = (statistics.median(each.scoring for each in runs) for runs in (alone, shared))
    for name, runs in (("one worker", alone), ("two workers", shared)):
        seconds = statistics.median(each.scoring for each in runs)
        figures.add(f"{name}, {runs[0].shards} shards", scored / seconds, "segments/s")
        figures.note(f"{name}: {', '.join(f'{each.scoring:.1f}' for each in runs)} s")
        figures.add(f"{name}: the merge", statistics.median(each.merging for each in runs), "s")
    figures.add("speed of two workers to one", one / two, "ratio", TARGET)
    assert all(len(each.owners) == 1 for each in alone), "another worker scored too"
    assert all(len(each.owners) == 2 for each in shared), "a worker scored nothing"
    assert len({each.queue for each in (*alone, *shared)}) == 1, "the same networks ranked otherwise"
    figures.none("jobs that were tried twice", sum(each.retried for each in (*alone, *shared)))


class _Run:
    """One scoring by its jobs' rows: seconds from the request to the last shard, and of the merge.

    workers: by job, who did it.
    """

    def __init__(
        self, asked: datetime, jobs: Sequence[JobRow], workers: dict[str, str], queue: tuple[tuple[str, int], ...]
    ) -> None:
        shards = [job for job in jobs if job.kind == "score_shard"]
        (merge,) = [job for job in jobs if job.kind == "merge_scores"]
        last = max(job.finished_at for job in shards if job.finished_at)
        assert merge.finished_at is not None
        self.shards, self.queue = len(shards), queue
        self.scoring = (last - asked).total_seconds()
        self.merging = (merge.finished_at - last).total_seconds()
        self.owners = {workers[str(job.id)] for job in shards}
        self.retried = sum(job.attempts > 1 for job in jobs)


def _trained(deployment: Deployment) -> Project:
    """A project with a current round on few labels, and no other work left for the queues."""
    client = deployment.client
    project = project_of(client, "scored", "cycle")
    collector = deployment.start_worker("label")
    labels = CollectionLabels(per_action=LABELS_PER_ACTION)
    asked = CollectionCreate(
        project=project.id, behavior="balanced", transitions=3000, seed=1, split="pool", labels=labels
    )
    client.wait_for_job(client.collect(asked).id, timeout=COLLECT_SECONDS)
    trainer = deployment.start_worker("train")
    deployment.await_round(client.start_round(project.id), ROUND_SECONDS)
    for worker in (collector, trainer):  # the subgoal generator goes back into its queue and waits there for good
        worker.end(signal.SIGTERM, 60)
    return project


def _await_both(deployment: Deployment, project: UUID) -> None:
    """Score until both workers have had a part in it: the second one has read torch, networks and files by then."""
    for _ in range(5):
        if len(_score(deployment, project).owners) == 2:
            return
    raise AssertionError(f"the second worker took no shard: {deployment.last_words()}")


def _is_ready(deployment: Deployment, scoring: UUID) -> bool:
    time.sleep(LOOK_SECONDS)  # to look all the time would cost the workers a fifth of a core
    with deployment.database.read() as session:
        status = scorings.find(session, scoring).status
        waiting = job_queries.unfinished(session, scoring)  # the merge's job ends a little after its queue is there
    assert status != "failed", deployment.last_words()
    return status == "ready" and waiting is None


def _score(deployment: Deployment, project: UUID) -> _Run:
    """Ask for a scoring of the whole pool, as a new round does, and wait for its queue."""
    asked = utc_now()
    limits = scorings.limits_of(Settings(shard_transitions=SHARD))
    with deployment.database.write() as session:
        current = round_queries.current_round(session, project)
        row = projects.find(session, project, lock=True)
        scoring = scorings.start(session, row, "cycle", current, asked, limits).id
    eventually(lambda: _is_ready(deployment, scoring), SCORE_SECONDS, deployment.last_words)
    with deployment.database.read() as session:
        jobs = session.scalars(select(JobRow).where(JobRow.subject_id == scoring)).all()
        done = select(EventRow).where(EventRow.project_id == project, EventRow.kind == "job.done")
        workers = {str(event.data["job"]): event.actor for event in session.scalars(done)}
        queue = session.scalars(select(QueueRow).where(QueueRow.scoring_id == scoring).order_by(QueueRow.rank))
        return _Run(asked, jobs, workers, tuple((each.trajectory_id, each.start) for each in queue))
