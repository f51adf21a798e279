"""A collection is cut anywhere, goes on in another worker behind the last stored batch, and ends with the same data."""

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from api_schemas.collections import CollectionCreate, CollectionLabels
from api_schemas.environments import Environment
from service import pool
from service.store.tables import JobRow
from tests.workers.conftest import OpenLoop, new_project
from tests.workers.in_process import Loop
from workers import collection, standing
from workers.dispatch import run_next
from workers.simulators.minigrid import MiniGridSimulator

LABELED: dict[str, Any] = {"transitions": 3000, "behavior": "balanced", "split": "held_out", "seed": 4}
LABELED["labels"] = CollectionLabels(per_action=60)
COUNTED: dict[str, Any] = {"trajectories": 9, "split": "pool", "seed": 4}


class Episodes:
    """Counts the episodes that begin; `at` the beginning of one, by its number, something happens."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.begun, self.at = 0, dict[int, Callable[[], object]]()
        reset = MiniGridSimulator.reset

        def counted(simulator: MiniGridSimulator, seed: int) -> Any:
            self.begun += 1
            self.at.pop(self.begun, lambda: None)()
            return reset(simulator, seed)

        patch.setattr(MiniGridSimulator, "reset", counted)


@pytest.fixture
def episodes(monkeypatch: pytest.MonkeyPatch) -> Episodes:
    monkeypatch.setattr(collection, "BATCH", 2)
    return Episodes(monkeypatch)


def crash() -> None:
    raise OSError(errno.EIO, "Input/output error")


def content(loop: Loop) -> dict[str, Any]:
    """What is there of a collection, as a user sees it."""
    labels = [
        (label.trajectory, label.start, label.actions, label.split) for label in loop.client.labels(loop.project.id)
    ]
    trajectories = sorted((each.id, each.split) for each in loop.client.trajectories(loop.project.id))
    return {"trajectories": trajectories, "labels": sorted(labels, key=str), "result": loop.jobs("collect")[-1].result}


def undisturbed(opened: OpenLoop, asked: dict[str, Any]) -> dict[str, Any]:
    loop = opened()
    new_project(loop)
    assert loop.collect(**asked).state == "done"
    return content(loop)


def ask(loop: Loop, asked: dict[str, Any]) -> None:
    loop.client.collect(CollectionCreate(project=loop.project.id, **asked))


def resumptions(loop: Loop) -> list[object]:
    """Trajectories that were stored when an attempt went on."""
    events = loop.client.events(loop.project.id)
    return [event.data["trajectories"] for event in events if event.kind == "collection.resumed"]


def checkpoints(loop: Loop) -> list[Path]:
    return [path for path in (loop.folder / "blobs" / "checkpoints").rglob("*") if path.is_file()]


def row_of(loop: Loop) -> JobRow:
    with loop.worker.database.read() as session:
        return session.get_one(JobRow, loop.jobs("collect")[-1].id)


@pytest.mark.parametrize("asked", [LABELED, COUNTED], ids=["labeled", "counted"])
def test_after_crashes_it_goes_on_behind_the_last_batch_and_ends_with_the_same(
    empty: Loop, opened: OpenLoop, episodes: Episodes, asked: dict[str, Any]
) -> None:
    expected = undisturbed(opened, asked)
    whole, episodes.begun = episodes.begun, 0
    assert whole >= 8
    episodes.at = {4: crash, 8: crash, 12: crash}  # batches are of two: each costs one episode and a beginning
    ask(empty, asked)
    for _ in range(4):
        empty.drain()
        empty.clock.advance(10)
    assert content(empty) == expected
    assert resumptions(empty) == [2, 4, 6]
    assert episodes.begun == whole + 3 * 2
    assert checkpoints(empty) == []
    assert row_of(empty).checkpoint_sha256 is None


def test_a_crash_in_the_transaction_of_a_batch_leaves_nothing_of_it(
    empty: Loop, opened: OpenLoop, episodes: Episodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = undisturbed(opened, COUNTED)
    add_all, batches = pool.add_all, []

    def fails_once(*arguments: Any) -> Any:
        batches.append(add_all(*arguments))
        if len(batches) == 3:
            crash()
        return batches[-1]

    monkeypatch.setattr(pool, "add_all", fails_once)
    ask(empty, COUNTED)
    empty.drain()
    assert (empty.project.counts.pool_trajectories, row_of(empty).result["trajectories"]) == (4, 4)
    empty.clock.advance(10)
    empty.drain()
    assert content(empty) == expected
    assert len(batches) == 6  # five, and the third once more


def test_batches_that_take_long_are_smaller(
    empty: Loop, opened: OpenLoop, episodes: Episodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = undisturbed(opened, COUNTED)
    monkeypatch.setattr(collection, "BATCH_SECONDS", 0.0)
    episodes.at = {episodes.begun + 4: crash}
    ask(empty, COUNTED)
    empty.drain()
    assert row_of(empty).result["trajectories"] == 3
    empty.clock.advance(10)
    empty.drain()
    assert content(empty) == expected


@pytest.mark.parametrize("damage", ["bytes", "version"])
def test_what_cannot_be_used_is_begun_anew(
    empty: Loop, opened: OpenLoop, episodes: Episodes, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    expected = undisturbed(opened, COUNTED)
    episodes.at = {episodes.begun + 6: crash}
    ask(empty, COUNTED)
    empty.drain()
    if damage == "bytes":
        checkpoints(empty)[0].write_bytes(b"torn")
    else:
        monkeypatch.setattr(standing, "VERSION", 2)
    empty.clock.advance(10)
    empty.drain()
    assert resumptions(empty) == []
    assert content(empty) == expected | {"result": expected["result"] | {"known_before": 4}}


def test_shards_share_the_work_and_draw_apart(empty: Loop, opened: OpenLoop) -> None:
    asked = empty.client.collect(CollectionCreate(project=empty.project.id, **COUNTED | {"shards": 3}))
    workers = [empty.another_worker() for _ in asked.jobs]
    assert all(run_next(worker) for worker in workers)
    results = [empty.client.job(job).result for job in asked.jobs]
    assert [result["trajectories"] for result in results] == [3, 3, 3]
    assert [result["known_before"] for result in results] == [0, 0, 0]
    assert empty.project.counts.pool_trajectories == 9
    one = {each for each, _ in undisturbed(opened, COUNTED)["trajectories"]}
    assert not one & {each for each, _ in content(empty)["trajectories"]}


def test_what_two_shards_draw_alike_is_stored_once_and_told(opened: OpenLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    reset = MiniGridSimulator.reset
    monkeypatch.setattr(MiniGridSimulator, "reset", lambda self, seed: reset(self, seed % 5))
    loop = opened()
    new_project(loop, environment=Environment(simulator="minigrid", options={"max_steps": 1}))
    asked = CollectionCreate(project=loop.project.id, transitions=16, behavior="random", split="pool", shards=2)
    started = loop.client.collect(asked)
    loop.drain()
    first, second = sorted(int(str(loop.client.job(job).result["known_before"])) for job in started.jobs)
    assert (first, second > 0) == (0, True)  # whichever of them ran first
    assert loop.project.counts.pool_trajectories == 16 - second
