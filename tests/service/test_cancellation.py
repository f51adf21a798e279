"""Cancelling: a job that is stopped for good, and what follows for its round or scoring."""

from uuid import UUID, uuid4

import pytest
from httpx2 import Response
from sqlalchemy import select

from service import jobs, rounds, scorings
from service.jobs import JobLost
from service.store.tables import JobRow, ProjectRow, RoundRow, ScoringRow
from tests.service.kit import Served, answers, refused, room
from tests.service.test_jobs import LEASE, enqueue, generator, kinds, round_asked_for
from workers.job import RunningJob


def cancel(served: Served, job: object, status: int = 200) -> Response:
    answer = served.client.delete(f"/jobs/{job}")
    assert answer.status_code == status, answer.text
    return answer


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
