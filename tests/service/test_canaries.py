"""Canaries: planted, done first, and planted again."""

from uuid import uuid4

from sqlalchemy import select

from api_schemas.jobs import ScoreShard
from service import canary, jobs
from service.store.tables import JobRow
from tests.service.kit import Served
from tests.service.test_jobs import LEASE, claimed, enqueue, kinds, reap


def plant(served: Served, every: float = 15.0) -> None:
    with served.services.database.write() as session:
        canary.plant(session, served.clock(), every)


def canaries(served: Served) -> dict[str, str]:
    """State by queue."""
    with served.services.database.read() as session:
        return {row.queue: row.state for row in session.scalars(select(JobRow).where(JobRow.kind == "canary"))}


def test_canaries_come_first_and_are_planted_again_after_a_while(on_both: Served) -> None:
    project = on_both.project()
    enqueue(on_both, project, ScoreShard(scoring=uuid4(), shard=0))
    for _ in range(2):
        plant(on_both)
    assert canaries(on_both) == dict.fromkeys(("train", "score", "label"), "queued")
    for queue in ("train", "score", "label"):
        lease = claimed(on_both, queue)
        assert lease.job_id == canary.job_id(queue)
        with on_both.services.database.write() as session:
            jobs.complete(session, lease, canary.done(on_both.clock()), on_both.clock())
    plant(on_both)
    assert set(canaries(on_both).values()) == {"done"}
    on_both.clock.advance(16)
    plant(on_both)
    assert set(canaries(on_both).values()) == {"queued"}
    shown = on_both.get(f"/jobs/{canary.job_id('train')}")
    assert (shown["project"], shown["attempts"]) == (None, 0)
    assert kinds(on_both, project) == ["job.queued"]  # that of the shard
    with on_both.services.database.write() as session:  # the service is other tests' too
        for row in session.scalars(select(JobRow).where(JobRow.state == "queued")):
            row.state, row.finished_at = "failed", on_both.clock()


def test_a_canary_that_failed_is_planted_again(served: Served) -> None:
    plant(served)
    for _ in range(3):
        claimed(served, "label")
        served.clock.advance(LEASE + 1)
        reap(served)
        served.clock.advance(60)
    assert canaries(served)["label"] == "failed"
    plant(served)
    assert canaries(served)["label"] == "queued"
    lease = claimed(served, "label")
    with served.services.database.read() as session:
        assert jobs.find(session, lease.job_id).attempts == 1
