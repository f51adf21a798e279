"""The job table: claimed by priority under a lease and a fence, taken from the silent, at last given up."""

from collections.abc import Callable
from uuid import UUID, uuid4

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from api_schemas.jobs import JobPayload, ScoreShard, TrainRound, TrainSubgoalGenerator
from service import jobs, reaper, scorings
from service.errors import UnknownResource
from service.jobs import JobLost
from service.store.tables import JobRow, ProjectRow, ScoringRow
from tests.service.conftest import Serve
from tests.service.kit import Served, answers, room
from workers.dispatch import run_job, run_next
from workers.job import RunningJob

LEASE = 15.0


def enqueue(served: Served, project: str, payload: JobPayload, max_attempts: int = 5) -> UUID:
    with served.services.database.write() as session:
        subject = getattr(payload, "scoring", None) or UUID(project)
        return jobs.enqueue(session, UUID(project), payload, subject, served.clock(), max_attempts).id


def claim(served: Served, *queues: str, owner: str = "ada") -> jobs.Lease | None:
    with served.services.database.write() as session:
        row = jobs.claim_next(session, queues or ("train",), owner, served.clock(), LEASE)
        return None if row is None else jobs.lease_of(row)


def claimed(served: Served, *queues: str, owner: str = "ada") -> jobs.Lease:
    lease = claim(served, *queues, owner=owner)
    assert lease is not None
    return lease


def reap(served: Served) -> None:
    reaper.reap(served.services.database, served.clock())


def kinds(served: Served, project: str) -> list[str]:
    """Kinds of the events about jobs, oldest first."""
    return [row["kind"] for row in served.events(project) if row["kind"].startswith("job.")]


def round_asked_for(served: Served, project: str) -> str:
    """A label, and the path of a round on it whose job waits."""
    served.upload(project, room(0))
    batch = served.acquire(project, 1)
    assert served.label(project, answers(batch), batch).is_success
    started = served.client.post("/rounds", json={"project": project})
    assert started.status_code == 202, started.text
    return str(started.headers["location"])


def generator(project: str) -> TrainSubgoalGenerator:
    return TrainSubgoalGenerator(project=UUID(project))


def test_the_highest_priority_goes_first_then_the_oldest(on_both: Served) -> None:
    project = on_both.project()
    queue = "train"
    with on_both.services.database.write() as session:  # a shared database may hold other tests' jobs
        for row in session.scalars(select(JobRow).where(JobRow.state == "queued")):
            row.state = "failed"
    low = enqueue(on_both, project, generator(project))
    first = enqueue(on_both, project, TrainRound(round=uuid4(), strategy="cycle"))
    second = enqueue(on_both, project, TrainRound(round=uuid4(), strategy="cycle"))
    assert claim(on_both, "score", "default") is None
    assert [claimed(on_both, queue).job_id for _ in range(3)] == [first, second, low]
    assert claim(on_both, queue) is None


def test_a_heartbeat_keeps_the_job_and_shows_its_progress(served: Served) -> None:
    project = served.project()
    job = enqueue(served, project, generator(project))
    lease = claimed(served)
    for beat in range(3):
        served.clock.advance(LEASE - 1)
        with served.services.database.write() as session:
            jobs.heartbeat(session, lease, served.clock, LEASE, beat / 4, f"epoch {beat}")
        reap(served)
    shown = served.get(f"/jobs/{job}")
    assert (shown["state"], shown["attempts"], shown["progress"], shown["message"]) == ("running", 1, 0.5, "epoch 2")


def test_a_silent_workers_job_goes_to_another_and_its_late_writes_are_refused(on_both: Served) -> None:
    project = on_both.project()
    job = enqueue(on_both, project, generator(project))
    with on_both.services.database.write() as session:
        row = jobs.claim(session, job, "silent", on_both.clock(), LEASE)
        assert row is not None
        silent = jobs.lease_of(row)
    on_both.clock.advance(LEASE + 1)
    reap(on_both)
    shown = on_both.get(f"/jobs/{job}")
    assert (shown["state"], shown["attempts"]) == ("queued", 1)
    assert "silent" in shown["error"]
    on_both.clock.advance(2)
    with on_both.services.database.write() as session:
        row = jobs.claim(session, job, "ada", on_both.clock(), LEASE)
        assert row is not None
        mine = jobs.lease_of(row)
    assert mine.fence > silent.fence
    late = RunningJob(on_both.worker("train"), silent)
    with pytest.raises(JobLost, match=f"{job}.*{silent.fence}"), late.transaction() as session:
        session.get_one(ProjectRow, UUID(project)).seed = 99
    assert on_both.show(project)["seed"] == 0
    writes: list[Callable[[Session], object]] = [
        lambda session: jobs.complete(session, silent, {}, on_both.clock()),
        lambda session: jobs.fail(session, silent, "late", on_both.clock(), retry=True),
        lambda session: jobs.give_back(session, silent, on_both.clock()),
        lambda session: jobs.heartbeat(session, silent, on_both.clock, LEASE, 1.0, "late"),
    ]
    for write in writes:
        with pytest.raises(JobLost), on_both.services.database.write() as session:
            write(session)
    assert on_both.get(f"/jobs/{job}")["state"] == "running"
    with RunningJob(on_both.worker("train"), mine).transaction() as session:
        session.get_one(ProjectRow, UUID(project)).seed = 7
    assert on_both.show(project)["seed"] == 7


def test_a_job_whose_lease_ran_out_can_be_claimed_without_the_reaper(served: Served) -> None:
    project = served.project()
    job = enqueue(served, project, generator(project))
    claimed(served)
    with served.services.database.write() as session:
        assert jobs.claim(session, job, "bob", served.clock(), LEASE) is None
    served.clock.advance(LEASE + 1)
    with served.services.database.write() as session:
        row = jobs.claim(session, job, "bob", served.clock(), LEASE)
        assert row is not None
        assert (row.owner, row.attempts) == ("bob", 2)


def test_a_job_given_back_has_lost_no_attempt(served: Served) -> None:
    project = served.project()
    enqueue(served, project, generator(project), max_attempts=1)
    for _ in range(3):
        lease = claimed(served)
        with served.services.database.write() as session:
            jobs.give_back(session, lease, served.clock())
    assert claimed(served).fence == 4
    assert served.get("/jobs", project=project)["items"][0]["attempts"] == 1


def test_a_failed_attempt_waits_before_the_next_and_the_last_fails_the_job(served: Served) -> None:
    project = served.project()
    job = enqueue(served, project, generator(project), max_attempts=3)
    for pause in (1.0, 5.0):
        lease = claimed(served)
        with served.services.database.write() as session:
            jobs.fail(session, lease, "the disk is full", served.clock(), retry=True)
        assert claim(served) is None
        served.clock.advance(pause)
    with served.services.database.write() as session:
        row = jobs.fail(session, claimed(served), "the disk is full", served.clock(), retry=True)
        assert row.state == "failed"
    shown = served.get(f"/jobs/{job}")
    assert (shown["state"], shown["attempts"], shown["error"]) == ("failed", 3, "the disk is full")
    assert shown["finished_at"] is not None
    served.clock.advance(1000)
    assert claim(served) is None
    assert kinds(served, project) == ["job.queued", *2 * ["job.started", "job.retried"], "job.started", "job.failed"]


def test_a_job_that_cannot_succeed_fails_at_once(served: Served) -> None:
    project = served.project()
    served.upload(project, room(0))
    served.ask(project, 1)
    assert run_next(served.worker("score"))
    (scores,) = [path for path in (served.settings.data_folder / "blobs" / "scores").rglob("*") if path.is_file()]
    scores.write_bytes(b"torn")
    assert served.drain() == 1
    merge = served.get("/jobs", project=project)["items"][0]
    assert (merge["kind"], merge["state"], merge["attempts"]) == ("merge_scores", "failed", 1)
    assert "CorruptBlob" in merge["error"]
    assert scores.name in merge["error"]
    assert len(served.acquire(project, 1)["items"]) == 1  # scored again, and the blob mended


def test_a_round_fails_with_its_last_silent_attempt(start: Serve) -> None:
    served = start(job_max_attempts=2)
    project = served.project()
    served.upload(project, room(0))
    batch = served.acquire(project, 1)
    served.label(project, answers(batch), batch)
    started = served.client.post("/rounds", json={"project": project})
    assert started.status_code == 202
    for attempt in (1, 2):
        lease = claimed(served)
        assert str(lease.job_id) == started.json()["job"]
        served.clock.advance(LEASE + 60)
        reap(served)
        shown = served.get(started.headers["location"])
        assert shown["status"] == ("queued" if attempt == 1 else "failed")
        served.clock.advance(60)
    assert started.json()["job"] in shown["error"]
    assert "fell silent in attempt 2 of 2" in shown["error"]


def test_a_scoring_fails_with_a_shard_and_the_next_acquire_starts_another(start: Serve) -> None:
    served = start(job_max_attempts=1)
    project = served.project()
    served.upload(project, room(0))
    first = served.ask(project, 1).json()["job"]
    claimed(served, "score")
    served.clock.advance(LEASE + 1)
    reap(served)
    with served.services.database.read() as session:
        assert [row.status for row in session.scalars(select(ScoringRow))] == ["failed"]
    second = served.ask(project, 1).json()["job"]
    assert second != first
    assert len(served.acquire(project, 1)["items"]) == 1


def test_a_finished_job_is_not_run_again(served: Served) -> None:
    project = served.project()
    served.upload(project, room(0))
    job = UUID(served.ask(project, 1).json()["job"])
    worker = served.worker("score")
    assert run_job(worker, job) is True
    assert run_job(worker, job) is False
    assert run_job(worker, uuid4()) is False
    assert run_next(worker) is True
    assert run_next(worker) is False
    with served.services.database.read() as session:
        assert session.get_one(JobRow, job).attempts == 1


def test_a_shard_that_is_scored_twice_is_merged_once(served: Served) -> None:
    project = served.project()
    served.upload(project, room(0))
    job = UUID(served.ask(project, 1).json()["job"])
    with served.services.database.write() as session:
        payload = jobs.payload_of(jobs.find(session, job))
        assert isinstance(payload, ScoreShard)
        for _ in range(2):
            scorings.shard_scored(session, payload.scoring, 0, "0" * 64, served.clock(), served.services.limits)
        with pytest.raises(UnknownResource, match="shard"):
            scorings.shard_scored(session, payload.scoring, 1, "0" * 64, served.clock(), served.services.limits)
    kinds = [row["kind"] for row in served.get("/jobs", project=project)["items"]]
    assert kinds.count("merge_scores") == 1


def test_a_stopping_worker_gives_its_job_back(served: Served) -> None:
    project = served.project()
    served.upload(project, room(0))
    job = served.ask(project, 1).json()["job"]
    assert run_next(served.worker("score"))
    worker = served.worker("score")
    worker.stopping.set()
    assert run_next(worker)
    worker.stopping.clear()
    (merge,) = [row for row in served.get("/jobs", project=project)["items"] if row["id"] != job]
    assert (merge["state"], merge["attempts"]) == ("queued", 0)
    assert served.drain() == 1
    assert served.ask(project, 1).status_code == 201


def test_every_change_of_a_job_says_who_and_on_whose_request(served: Served) -> None:
    project = served.project()
    served.upload(project, room(0))
    asked = served.client.post(
        "/acquire", json={"project": project, "count": 1}, headers={"X-Correlation-ID": "morning-run"}
    )
    assert asked.status_code == 202
    served.drain()
    claimed_by, rows = served.worker("score").owner, served.get("/events", project=project, limit=1000)["items"]
    told = [(row["kind"], row["data"]["kind"], row["actor"]) for row in rows if row["kind"].startswith("job.")]
    assert told == [
        ("job.queued", "score_shard", "local"),
        ("job.started", "score_shard", claimed_by),
        ("job.queued", "merge_scores", claimed_by),
        ("job.done", "score_shard", claimed_by),
        ("job.started", "merge_scores", claimed_by),
        ("job.done", "merge_scores", claimed_by),
    ]
    assert {row["correlation"] for row in rows if row["kind"].startswith("job.")} == {"morning-run"}


def test_what_the_reaper_does_bears_its_name_and_the_request(start: Serve) -> None:
    served = start(job_max_attempts=1)
    project = served.project()
    location = round_asked_for(served, project)
    asked = served.get("/events", project=project, newest=True)["items"][0]["correlation"]
    claimed(served)
    served.clock.advance(LEASE + 1)
    reap(served)
    assert served.get(location)["status"] == "failed"
    rows = served.get("/events", project=project, newest=True)["items"][:2]
    assert [(row["kind"], row["actor"], row["correlation"]) for row in rows] == [
        ("round.failed", "reaper", asked),
        ("job.failed", "reaper", asked),
    ]
    assert asked


def test_a_message_cannot_grant_an_attempt_more(served: Served) -> None:
    project = served.project()
    job = enqueue(served, project, generator(project), max_attempts=1)
    claimed(served)
    served.clock.advance(LEASE + 1)  # and the message arrives again before the reaper has come by
    with served.services.database.write() as session:
        assert jobs.claim(session, job, "bob", served.clock(), LEASE) is None
    reap(served)
    assert served.get(f"/jobs/{job}")["state"] == "failed"
