"""The job table: claimed by priority under a lease and a fence, taken from the silent, at last given up."""

import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from uuid import UUID, uuid4

import pytest
from httpx2 import Response
from sqlalchemy import select
from sqlalchemy.orm import Session
from structlog.testing import capture_logs

from api_schemas.jobs import JobPayload, ScoreShard, TrainRound, TrainSubgoalGenerator
from service import canary, jobs, reaper, rounds, scorings
from service.errors import JobLost, UnknownResource
from service.store.tables import JobRow, ProjectRow, RoundRow, ScoringRow
from tests.service.conftest import Serve
from tests.service.kit import Served, answers, refused, room
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


def cancel(served: Served, job: object, status: int = 200) -> Response:
    answer = served.client.delete(f"/jobs/{job}")
    assert answer.status_code == status, answer.text
    return answer


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


def test_a_cancelled_job_is_never_run(on_both: Served) -> None:
    project = on_both.project()
    job = enqueue(on_both, project, generator(project))
    assert cancel(on_both, job).json()["state"] == "cancelled"
    with on_both.services.database.write() as session:
        assert jobs.claim(session, job, "ada", on_both.clock(), LEASE) is None
    again = cancel(on_both, job).json()
    assert (again["state"], again["attempts"]) == ("cancelled", 0)
    assert kinds(on_both, project) == ["job.queued", "job.cancelled"]


def test_a_cancelled_jobs_holder_has_lost_it(on_both: Served) -> None:
    project = on_both.project()
    job = enqueue(on_both, project, generator(project))
    worker = on_both.worker("train")
    with on_both.services.database.write() as session:
        row = jobs.claim(session, job, worker.owner, on_both.clock(), LEASE)
        assert row is not None
        running = RunningJob(worker, jobs.lease_of(row))
    running.report(0.5, "half way")
    cancel(on_both, job)
    with pytest.raises(JobLost), running.transaction():
        pytest.fail("a cancelled job may not write")
    running.beat()
    with pytest.raises(JobLost):
        running.report(0.6, "further")
    shown = on_both.get(f"/jobs/{job}")
    assert shown["state"] == "cancelled"
    assert shown["finished_at"] is not None


def test_a_job_that_has_ended_cannot_be_cancelled(served: Served) -> None:
    project = served.project()
    served.upload(project, room(0))
    job = served.ask(project, 1).json()["job"]
    served.drain()
    refused(cancel(served, job, 409), 409, "job-finished", job, "done")
    refused(cancel(served, uuid4(), 404), 404, "unknown-resource")


def test_cancelling_takes_an_admin(served: Served) -> None:
    project = served.project()
    job = enqueue(served, project, generator(project))
    key = served.client.post("/keys", json={"name": "reader", "scopes": ["read", "label", "acquire"]}).json()["secret"]
    answer = served.client.delete(f"/jobs/{job}", headers={"Authorization": f"Bearer {key}"})
    refused(answer, 403, "not-allowed", "admin")
    assert served.get(f"/jobs/{job}")["state"] == "queued"


def test_a_cancelled_round_ends_and_its_labels_are_not_due_again(served: Served) -> None:
    project = served.project(policy={"round_labels": 2})
    served.upload(project, room(0))
    batch = served.acquire(project, 3)
    assert served.label(project, answers(batch)[:2], batch).json()["round"] is not None
    (shown,) = served.get("/rounds", project=project)["items"]
    cancel(served, shown["job"])
    after = served.get(f"/rounds/{shown['id']}")
    assert (after["status"], after["error"]) == ("cancelled", None)
    assert after["finished_at"] is not None
    assert served.label(project, answers(batch)[2:], batch).json()["round"] is None
    newest = [row["kind"] for row in served.get("/events", project=project, newest=True, limit=1000)["items"]]
    assert newest.count("round.cancelled") == 1
    assert len(served.get("/rounds", project=project)["items"]) == 1
    assert served.client.post("/rounds", json={"project": project}).status_code == 202  # by hand it goes


def test_a_round_is_cancelled_with_its_scoring_and_the_next_acquire_starts_another(served: Served) -> None:
    project = served.project()
    location = round_asked_for(served, project)
    with served.services.database.write() as session:
        round_row = session.get_one(RoundRow, UUID(location.split("/")[-1]))
        round_row.status = "scoring"
        row = session.get_one(ProjectRow, UUID(project))
        scoring = scorings.start(session, row, "cycle", round_row, served.clock(), served.services.limits)
        job = session.scalars(select(JobRow).where(JobRow.subject_id == scoring.id)).one().id
    cancel(served, job)
    with served.services.database.write() as session:
        assert session.get_one(ScoringRow, scoring.id).status == "failed"
        rounds.make_current(session, round_row.id, served.clock())
    assert served.get(location)["status"] == "cancelled"


def test_a_cancelled_scoring_without_a_round_leaves_the_project_usable(served: Served) -> None:
    project = served.project()
    served.upload(project, room(0))
    first = served.ask(project, 1).json()["job"]
    cancel(served, first)
    assert served.ask(project, 1).json()["job"] != first
    assert len(served.acquire(project, 1)["items"]) == 1


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


def test_no_job_gives_way_to_a_canary(served: Served) -> None:
    project = served.project()
    enqueue(served, project, generator(project))
    running = RunningJob(served.worker("train"), claimed(served))
    running.prepared()
    time.sleep(0.01)
    plant(served)
    assert not running.should_give_way()
    enqueue(served, project, TrainRound(round=uuid4(), strategy="cycle"))
    assert running.should_give_way()


def test_a_job_works_for_as_long_as_it_took_to_get_ready_before_it_gives_way(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    project, seconds = served.project(), [100.0]
    monkeypatch.setattr("workers.job.time", SimpleNamespace(monotonic=lambda: seconds[0]))
    enqueue(served, project, generator(project))
    worker = served.worker("train")
    running = RunningJob(worker, claimed(served))
    enqueue(served, project, TrainRound(round=uuid4(), strategy="cycle"))
    seconds[0] += 30
    assert not running.should_give_way()  # it is still loading
    running.prepared()
    seconds[0] += 29
    running.prepared()  # by the next stage
    assert not running.should_give_way()
    seconds[0] += 1
    assert running.should_give_way()
    seconds[0] -= 30
    worker.stopping.set()  # the process ends: that waits for nothing
    assert running.should_give_way()
    worker.stopping.clear()


def test_a_job_that_has_said_nothing_for_long_is_not_renewed_and_goes_to_another(
    on_both: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    project, seconds = on_both.project(), [100.0]
    monkeypatch.setattr("workers.job.time", SimpleNamespace(monotonic=lambda: seconds[0]))
    worker = on_both.worker("train")
    bounded = replace(worker, settings=worker.settings.model_copy(update={"silence_seconds": 60.0}))
    job = enqueue(on_both, project, generator(project))
    with on_both.services.database.write() as session:
        row = jobs.claim(session, job, worker.owner, on_both.clock(), LEASE)
        assert row is not None
        running = RunningJob(bounded, jobs.lease_of(row))
    with capture_logs() as said:
        for step in (running.go_on, lambda: running.report(0.5, "step 1"), lambda: _write(running)):
            seconds[0] += 61
            step()  # it was slow, and is not hung
            on_both.clock.advance(LEASE - 1)
            running.beat()
            reap(on_both)
            assert on_both.get(f"/jobs/{job}")["state"] == "running"
        seconds[0] += 61
        on_both.clock.advance(LEASE - 1)
        running.beat()
        on_both.clock.advance(2)
        running.beat()
        reap(on_both)
    assert on_both.get(f"/jobs/{job}")["state"] == "queued"
    hangs = [(line["job"], line["last"]) for line in said if line["event"] == "job_hangs"]
    assert hangs == [(str(job), "step 1")]
    with pytest.raises(JobLost):
        _write(running)


def _write(running: RunningJob) -> None:
    with running.transaction():
        pass
