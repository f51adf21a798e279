"""What must hold of a service at rest, whatever has happened to its processes: the one check of all crash tests."""

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from itertools import chain
from pathlib import Path
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import Session

from asim.client import Client
from service.store.blobs import Blobs
from service.store.tables import JobRow, ModelVersionRow, ProjectRow, RoundRow
from tests.loop.rows import Segment, check_rows, labels_of, repeated, segments_of, snapshot

BACKGROUND = ("train_subgoal_generator", "canary")  # the one runs for minutes behind all other work, the other for ever
Acknowledged = Iterable[Segment] | Mapping[UUID, Iterable[Segment]]


def check_invariants(
    client: Client,
    data_folder: Path,
    acknowledged: Acknowledged,
    *,
    database_url: str | None = None,
    exact: bool = False,
    ended: Collection[UUID] = (),
) -> None:
    """Labels, leases, counters, jobs, models and blobs of a service that has come to rest.

    acknowledged: the segments whose labels were answered with 2xx; by project where there are several.
    exact: every label in the database was acknowledged too, as where a client asks until it is answered.
    ended: jobs that may have failed or been cancelled, and rounds and scorings with them.
    """
    url = database_url or f"sqlite:///{data_folder / 'asim.db'}"
    with snapshot(url) as session:
        check_rows(session)
        _check_acknowledged(session, acknowledged, exact=exact)
        _check_jobs(session, ended)
        _check_rounds(session, ended)
        _check_registry(session, Blobs(str(data_folder / "blobs")))
    for project in client.projects():
        _check_answers(client, project.id)
        _check_weights(client, project.id)
    _check_blobs(data_folder)


def retries(client: Client, job: UUID | None) -> int:
    """How often the job lost its worker. Its attempts do not tell: they are counted from the last stored stage."""
    return sum(event.kind == "job.retried" and event.data["job"] == str(job) for event in client.events())


def _check_acknowledged(session: Session, acknowledged: Acknowledged, *, exact: bool) -> None:
    """What was acknowledged is there."""
    projects = session.scalars(select(ProjectRow.id)).all()
    if not isinstance(acknowledged, Mapping):
        (project,) = projects
        acknowledged = {project: acknowledged}
    for project, segments in acknowledged.items():
        told, found = set(segments), set(segments_of(labels_of(session, project)))
        assert sorted(told - found) == [], "labels that were acknowledged and are lost"
        if exact:
            assert sorted(found - told) == [], "labels that were never acknowledged"


def _check_jobs(session: Session, ended: Collection[UUID]) -> None:
    for job in session.scalars(select(JobRow)):
        allowed = job.state == "done" or (job.id in ended and job.state in ("failed", "cancelled"))
        resting = job.kind in BACKGROUND and job.state in ("queued", "running")
        assert allowed or resting, f"job {job.kind} is {job.state} after {job.attempts} attempts: {job.error}"


def _check_rounds(session: Session, ended: Collection[UUID]) -> None:
    for row in session.scalars(select(RoundRow)):
        allowed = row.status in ("current", "superseded")
        assert allowed or (row.job_id in ended and row.status in ("failed", "cancelled")), f"{row.number}: {row.status}"


def _check_registry(session: Session, blobs: Blobs) -> None:
    """The stored weights are what the registry says; reading a blob checks its hash."""
    for model in session.scalars(select(ModelVersionRow)):
        assert len(blobs.get("weights", model.sha256)) == model.bytes, f"weights of model {model.id}"


def _check_answers(client: Client, project: UUID) -> None:
    """What the API says of a project is what its listings add up to."""
    labels = list(client.labels(project))
    assert repeated(Counter((label.trajectory, label.start) for label in labels)) == [], "labels listed twice"
    assert [label.watermark for label in labels] == list(range(1, len(labels) + 1)), "watermarks with gaps"
    counts = client.project(project).counts
    assert counts.pool_segments == counts.unlabeled + counts.leased + counts.labeled
    assert counts.labeled == sum(label.split == "pool" for label in labels)
    trajectories = [each for each in client.trajectories(project) if each.split == "pool"]
    assert counts.pool_segments == sum(each.segments for each in trajectories)
    assert counts.labeled == sum(each.labeled for each in trajectories)


def _check_weights(client: Client, project: UUID) -> None:
    """What is served of the round in use is what the registry says."""
    current = client.project(project).current_round
    for model in client.models(project):
        if model.round == current:
            weights = client.weights(model.id)
            assert hashlib.sha256(weights).hexdigest() == model.sha256, f"weights of model {model.id}"


def _check_blobs(data_folder: Path) -> None:
    """A stored object's name is the hash of its bytes; what a killed writer left half done has another name."""
    stored = chain((data_folder / "blobs").rglob("*/*/*"), (data_folder / "provenance").rglob("*/*/*"))
    for path in stored:
        if len(path.name) == 64:
            assert hashlib.sha256(path.read_bytes()).hexdigest() == path.name, f"torn object {path}"
