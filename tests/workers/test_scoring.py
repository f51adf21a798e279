"""Scoring: every pool segment once, by the round's own networks, and nothing queued that is taken."""

import threading
from typing import Any
from uuid import UUID

import numpy as np
import pytest
import torch
from sqlalchemy import event

from models.acquisition import BATCH_RULES, STRATEGIES
from models.acquisition.base import score_pool
from service import scorings
from service.settings import Settings
from service.store.blobs import Blobs
from service.store.queries import acquisitions as queries
from service.store.queries import pool as pool_queries
from service.store.tables import ProjectRow, QueueRow, ScoringRow
from tests.workers.conftest import OpenLoop, new_project
from tests.workers.in_process import Loop, segments_of
from workers import data, scoring
from workers.dispatch import run_next

Segment = tuple[str, int]


def newest(loop: Loop, strategy: str) -> ScoringRow:
    """The scoring of a strategy that acquire uses now."""
    with loop.worker.database.read() as session:
        current = loop.project.current_round if scorings.NEEDS[strategy] else None
        row = queries.newest_scoring(session, loop.project.id, strategy, current)
    assert row is not None
    return row


def queue_of(loop: Loop, scoring_id: UUID) -> list[tuple[Segment, float | None]]:
    """Segments and scores of a ranked queue, best first."""
    with loop.worker.database.read() as session:
        rows = session.query(QueueRow).filter_by(scoring_id=scoring_id).order_by(QueueRow.rank).all()
    return [((row.trajectory_id, row.start), row.score) for row in rows]


def stored_scores(loop: Loop, scoring_id: UUID) -> list[tuple[Segment, float]]:
    """Every score of every shard, in the pool's order."""
    with loop.worker.database.read() as session:
        shas = [shard.blob_sha256 for shard in queries.shards(session, scoring_id)]
        names = {row.id: row.trajectory_id for row in pool_queries.memberships(session, loop.project.id, "pool")}
    pool = scoring._unpack(loop.blobs, [sha for sha in shas if sha is not None])
    segments = [(names[int(member)], int(start)) for member, start in zip(pool.members, pool.starts, strict=True)]
    return list(zip(segments, pool.scores.tolist(), strict=True))


def pool_of(loop: Loop) -> list[Segment]:
    """All pool segments, as the listing of trajectories gives them."""
    listed = [each for each in loop.client.trajectories(loop.project.id) if each.split == "pool"]
    stride = loop.project.stride
    return [(each.id, start) for each in listed for start in range(0, each.segments * stride, stride)]


def labeled_of(loop: Loop) -> set[Segment]:
    return {(label.trajectory, label.start) for label in loop.client.labels(loop.project.id)}


@pytest.mark.parametrize("strategy", ["confident_cycle", "random"])
def test_shards_cover_every_segment_once(opened: OpenLoop, trained_folder: Any, strategy: str) -> None:
    loop = opened(trained_folder, shard_transitions=90)
    loop.collect(45, seed=31, split="pool")
    loop.label(3, "random")
    loop.train()
    loop.acquire(1, strategy)
    found = newest(loop, strategy)
    assert 3 <= found.shards <= 8
    scored = [segment for segment, _ in stored_scores(loop, found.id)]
    assert sorted(scored) == sorted(pool_of(loop))
    assert len(scored) == len(set(scored)) == 645


def test_scores_are_those_of_the_strategy_on_the_rounds_networks(opened: OpenLoop, trained_folder: Any) -> None:
    loop = opened(trained_folder, shard_transitions=150)
    loop.label(3)
    loop.train()
    found = newest(loop, "confident_cycle")
    with loop.worker.database.read() as session:
        project = session.get_one(ProjectRow, loop.project.id)
        models = scoring.load_models(
            loop.worker.database, loop.blobs, project, found.round_id, STRATEGIES["confident_cycle"].needs
        )
        windows = data.windows_of(session, project, pool_queries.memberships(session, project.id, "pool"), None)
    batch = data.load(loop.blobs, windows, 1)
    direct = score_pool(STRATEGIES["confident_cycle"], models, batch, torch.Generator())
    stored = stored_scores(loop, found.id)
    assert found.shards > 2
    assert [segment for segment, _ in stored] == [(each.trajectory, each.start) for each in batch.segments]
    np.testing.assert_allclose([score for _, score in stored], direct.numpy(), rtol=1e-4, atol=1e-5)
    scores = dict(stored)
    assert all(score == scores[segment] for segment, score in queue_of(loop, found.id))


def test_under_top_the_queue_is_the_order_of_scores(trained: Loop) -> None:
    trained.change(batch_rule="top")
    trained.label(3)
    trained.train()
    scores = [score for _, score in queue_of(trained, newest(trained, "confident_cycle").id)]
    assert scores == sorted(scores, key=lambda score: -float(score or 0))
    best = [item.score for item in trained.acquire(10).items]
    assert best == scores[:10]


def test_items_tell_how_sure_the_inverse_model_was(trained: Loop) -> None:
    batch = trained.acquire(10)
    told = [item.confidence for item in batch.items]
    assert all(sure is not None and 1 / 7 <= sure <= 1 for sure in told)
    assert len(set(told)) > 5
    assert [item.confidence for item in trained.client.acquisition(batch.id).items] == told  # kept, not only answered
    assert {item.confidence for item in trained.acquire(5, "random").items} == {None}
    assert {item.confidence for item in trained.acquire(5, "self_inverse").items} == {None}


def test_every_batch_rule_queues_the_same_segments_in_its_own_order(trained: Loop) -> None:
    ranked = []
    for rule in BATCH_RULES:
        trained.change(batch_rule=rule)
        trained.client.start_round(trained.project.id)
        trained.drain()
        ranked.append([segment for segment, _ in queue_of(trained, newest(trained, "confident_cycle").id)])
    assert all(set(each) == set(ranked[0]) for each in ranked)
    assert len({tuple(each) for each in ranked}) == len(BATCH_RULES)


def test_labeled_and_leased_segments_are_not_queued(trained: Loop) -> None:
    leased = set(segments_of(trained.acquire(25)))
    expired = set(segments_of(trained.acquire(20, lease_seconds=1)))
    trained.clock.advance(5)
    trained.label(5, "random")
    trained.train()
    queued = {segment for segment, _ in queue_of(trained, newest(trained, "confident_cycle").id)}
    assert not queued & leased
    assert not queued & labeled_of(trained)
    assert expired - labeled_of(trained) <= queued
    assert queued == set(pool_of(trained)) - leased - labeled_of(trained)


def test_the_queue_is_no_longer_than_the_setting(opened: OpenLoop, trained_folder: Any) -> None:
    loop = opened(trained_folder, queue_length=30)
    loop.label(3)
    loop.train()
    found = newest(loop, "confident_cycle")
    queued, scored = queue_of(loop, found.id), stored_scores(loop, found.id)
    taken = labeled_of(loop)
    best = sorted((score for segment, score in scored if segment not in taken), reverse=True)[:30]
    assert sorted((score or 0.0 for _, score in queued), reverse=True) == best


def test_a_drained_queue_is_selected_again_without_scoring(opened: OpenLoop, trained_folder: Any) -> None:
    loop = opened(trained_folder, queue_length=30)
    loop.label(3)
    loop.train()
    shards = len(loop.jobs("score_shard"))
    batches = [segments_of(loop.acquire(25)) for _ in range(6)]
    given = [segment for batch in batches for segment in batch]
    assert len(given) == len(set(given)) == 150
    assert len(loop.jobs("score_shard")) == shards
    assert loop.jobs("select_queue")


@pytest.mark.parametrize("strategy", ["confident_cycle", "random"])
def test_a_pool_that_grew_can_be_given_out_to_its_end(trained: Loop, strategy: str) -> None:
    trained.label(3)
    trained.train()
    trained.acquire(1, strategy)
    trained.collect(100, seed=51, split="pool")
    free = trained.project.counts.unlabeled
    given = segments_of(trained.acquire(free - 10, strategy)) + segments_of(trained.acquire(10, strategy))
    assert len(set(given)) == free
    assert trained.project.counts.unlabeled == 0


@pytest.mark.parametrize("kind", ["shard_scored", "publish"])
def test_a_crash_while_scoring_costs_an_attempt_and_nothing_else(
    trained: Loop, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    trained.label(3)
    asked = trained.client.start_round(trained.project.id)
    real, calls = getattr(scorings, kind), []

    def once(*args: Any) -> Any:
        result = real(*args)
        calls.append(args)
        if len(calls) == 1:
            raise OSError(5, "Input/output error")  # after the rows, before the commit
        return result

    monkeypatch.setattr(scorings, kind, once)
    trained.drain()
    assert trained.client.round(asked.id).status == "scoring"
    assert trained.acquire(2).round != asked.id
    trained.clock.advance(10)
    trained.drain()
    assert trained.client.round(asked.id).status == "current"
    queued = [segment for segment, _ in queue_of(trained, newest(trained, "confident_cycle").id)]
    assert len(queued) == len(set(queued)) == trained.project.counts.unlabeled
    assert [job.attempts for job in trained.jobs("merge_scores")[-1:]] == [2 if kind == "publish" else 1]


def test_a_finished_merge_that_runs_again_leaves_a_whole_queue(trained: Loop) -> None:
    trained.label(3)
    trained.train()
    found = newest(trained, "confident_cycle")
    before = {segment for segment, _ in queue_of(trained, found.id)}
    given = set(segments_of(trained.acquire(7)))
    trained.requeue(trained.jobs("merge_scores")[-1].id)
    assert trained.drain() == 1
    assert {segment for segment, _ in queue_of(trained, found.id)} == before - given
    assert newest(trained, "confident_cycle").status == "ready"


def test_a_finished_shard_that_runs_again_starts_no_second_merge(trained: Loop) -> None:
    merges = len(trained.jobs("merge_scores"))
    trained.requeue(trained.jobs("score_shard")[-1].id)
    assert run_next(trained.worker)
    assert trained.jobs("score_shard")[-1].result == {"scored": 0}
    assert len(trained.jobs("merge_scores")) == merges


def test_a_stopping_worker_gives_a_shard_back(trained: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    trained.ask_for_queue("vanilla_cycle")
    run_next(trained.worker)  # trains the dense inverse dynamics

    def stop(*args: Any, **more: Any) -> torch.Tensor:
        trained.worker.stopping.set()
        return score_pool(*args, **more)

    monkeypatch.setattr(scoring, "score_pool", stop)
    run_next(trained.worker)
    job = trained.jobs("score_shard")[-1]
    assert (job.state, job.attempts) == ("queued", 0)
    trained.drain(trained.another_worker())
    assert trained.acquire(4, "vanilla_cycle").strategy == "vanilla_cycle"


def test_longer_segments_are_scored_and_trained_as_wholes(empty: Loop) -> None:
    empty.name = "long"
    new_project(empty, segment_length=3)
    empty.collect(300, seed=1, split="pool")
    empty.label(20, "random")
    empty.train()
    found = newest(empty, "confident_cycle")
    assert sorted(segment for segment, _ in stored_scores(empty, found.id)) == sorted(pool_of(empty))
    batch = empty.label(5)
    assert batch.strategy == "confident_cycle"
    assert all(item.start % 3 == 0 and item.length == 3 for item in batch.items)


def test_no_blob_is_read_inside_a_transaction(trained: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    """The store may take minutes; a database ends transactions that sit idle for half of one."""
    trained.label(3)
    asked = trained.client.start_round(trained.project.id)
    held, read = Connections(trained), set[str]()
    get = Blobs.get

    def watched(blobs: Blobs, kind: str, sha256: str) -> bytes:
        assert not held.by_the_job, f"a {kind} blob is read while a connection is held"
        read.add(kind)
        return get(blobs, kind, sha256)

    monkeypatch.setattr(Blobs, "get", watched)
    trained.drain()
    assert [job.error for job in trained.client.jobs(trained.project.id) if job.error] == []
    assert read == {"trajectories", "weights", "scores"}
    assert trained.client.round(asked.id).status == "current"


class Connections:
    """Counts the worker's connections that this thread holds; the heartbeat's are its own."""

    def __init__(self, loop: Loop) -> None:
        self.by_the_job, thread = 0, threading.get_ident()

        def count(change: int) -> None:
            if threading.get_ident() == thread:
                self.by_the_job += change

        pool = loop.worker.database.engine.pool
        event.listen(pool, "checkout", lambda *_: count(1))
        event.listen(pool, "checkin", lambda *_: count(-1))


def test_limits_come_from_the_settings() -> None:
    limits = scorings.limits_of(Settings(queue_length=7, shard_transitions=11, job_max_attempts=3))
    assert (limits.queue_length, limits.shard_segments, limits.max_attempts) == (7, 11, 3)
