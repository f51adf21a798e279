"""What must hold of a data folder after whatever has happened to its processes."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import Session

from asim.client import Client
from service.clock import utc_now
from service.store.database import open_database
from service.store.tables import AcquisitionItemRow, AcquisitionRow, ClaimRow, LabelRow, ModelVersionRow

Segment = tuple[str, int]
BACKGROUND = "train_subgoal_generator"  # runs for minutes behind all other work


def check_invariants(client: Client, data_folder: Path, acknowledged: Iterable[Segment]) -> None:
    """Labels, leases, jobs, models and blobs of a service that has come to rest with one project.

    acknowledged: the segments whose labels were answered with 2xx.
    """
    (project,) = client.projects()
    _check_labels(client, project.id, acknowledged)
    _check_counts(client, project.id)
    _check_jobs(client, project.id)
    _check_models(client, project.id)
    database = open_database(f"sqlite:///{data_folder / 'asim.db'}")
    with database.read() as session:
        _check_rows(session)
        _check_leases(session, client, project.id)
    database.close()
    _check_blobs(data_folder)


def retries(client: Client, job: UUID | None) -> int:
    """How often the job lost its worker. Its attempts do not tell: they are counted from the last stored stage."""
    return sum(event.kind == "job.retried" and event.data["job"] == str(job) for event in client.events())


def _check_labels(client: Client, project: UUID, acknowledged: Iterable[Segment]) -> None:
    listed = Counter((label.trajectory, label.start) for label in client.labels(project))
    assert repeated(listed) == [], "labels listed twice"
    assert sorted(set(acknowledged) - set(listed)) == [], "labels that were acknowledged and are lost"
    watermarks = [label.watermark for label in client.labels(project)]
    assert watermarks == list(range(1, len(watermarks) + 1)), "watermarks with gaps"


def _check_counts(client: Client, project: UUID) -> None:
    counts = client.project(project).counts
    assert counts.pool_segments == counts.unlabeled + counts.leased + counts.labeled
    labels = [label for label in client.labels(project) if label.split == "pool"]
    assert counts.labeled == len(labels)
    trajectories = [each for each in client.trajectories(project) if each.split == "pool"]
    assert counts.pool_segments == sum(each.segments for each in trajectories)
    assert counts.labeled == sum(each.labeled for each in trajectories)


def _check_jobs(client: Client, project: UUID) -> None:
    for job in client.jobs(project):
        resting = job.kind == BACKGROUND and job.state in ("queued", "running")
        assert job.state == "done" or resting, (
            f"job {job.kind} is {job.state} after {job.attempts} attempts: {job.error}"
        )


def _check_models(client: Client, project: UUID) -> None:
    rounds = list(client.rounds(project))
    assert repeated(Counter(each.number for each in rounds)) == []
    assert [each.status for each in rounds].count("current") == min(1, len(rounds))
    assert all(each.status in ("current", "superseded") for each in rounds)
    for model in client.models(project):
        weights = client.weights(model.id)
        assert hashlib.sha256(weights).hexdigest() == model.sha256, f"weights of model {model.id}"
        assert len(weights) == model.bytes
    for each in rounds:
        names = [stage.name for stage in each.stages]
        assert len(names) == len(set(names)), f"round {each.number} did a stage twice: {names}"


def _check_rows(session: Session) -> None:
    """Unique indexes hold these; the rows are counted all the same."""
    labels = session.execute(select(LabelRow.project_id, LabelRow.trajectory_id, LabelRow.start)).all()
    assert repeated(Counter(map(tuple, labels))) == []
    stages = select(ModelVersionRow.round_id, ModelVersionRow.kind, ModelVersionRow.member)
    rows = session.execute(stages.where(ModelVersionRow.round_id.is_not(None))).all()
    assert repeated(Counter(map(tuple, rows))) == [], "two model versions of one stage"


def _check_leases(session: Session, client: Client, project: UUID) -> None:
    """The batches under live leases share no segment, and the claims are exactly what of them is unlabeled."""
    now = utc_now()
    live = select(AcquisitionRow.id).where(AcquisitionRow.status == "leased", AcquisitionRow.lease_expires_at > now)
    items = select(AcquisitionItemRow).where(AcquisitionItemRow.acquisition_id.in_(live))
    given = Counter((row.trajectory_id, row.start) for row in session.scalars(items))
    assert repeated(given) == [], "segments in two live leases"
    claims = [(row.trajectory_id, row.start) for row in session.scalars(select(ClaimRow)) if row.expires_at > now]
    labeled = {(label.trajectory, label.start) for label in client.labels(project)}
    assert sorted(claims) == sorted(set(given) - labeled), "claims that are not the open items of live leases"
    assert len(claims) == client.project(project).counts.leased
    tokens = session.scalars(select(AcquisitionRow.token)).all()
    assert len(tokens) == len(set(tokens)), "a lease token was given twice"


def _check_blobs(data_folder: Path) -> None:
    """A stored object's name is the hash of its bytes; what a killed writer left half done has another name."""
    stored = chain((data_folder / "blobs").rglob("*/*/*"), (data_folder / "provenance").rglob("*/*/*"))
    for path in stored:
        if len(path.name) == 64:
            assert hashlib.sha256(path.read_bytes()).hexdigest() == path.name, f"torn object {path}"


def repeated(counts: Mapping[Any, int]) -> list[Any]:
    """What was counted more than once."""
    return [key for key, count in counts.items() if count > 1]
