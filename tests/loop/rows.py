"""What must hold of the rows at any moment, whatever has happened to processes: the cheap half of the invariants."""

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import create_engine, select
from sqlalchemy.orm import Session

from service.clock import utc_now
from service.projects import policy_of
from service.store.database import open_database
from service.store.tables import (
    AcquisitionItemRow,
    AcquisitionRow,
    ClaimRow,
    EventRow,
    JobRow,
    LabelRow,
    MembershipRow,
    ModelVersionRow,
    ProjectRow,
    QueueRow,
    RoundRow,
)

Segment = tuple[str, int]


@contextmanager
def snapshot(url: str) -> Iterator[Session]:
    """A session that sees one moment of the database, SQLite or PostgreSQL, while others write on."""
    if url.startswith("sqlite"):
        database = open_database(url)
        with database.read() as session:
            yield session
        database.close()
        return
    engine = create_engine(url, isolation_level="REPEATABLE READ")
    with Session(engine) as session:
        yield session
    engine.dispose()


def check_rows(session: Session) -> None:
    """Labels, counters, leases, budgets, rounds and jobs of all projects, in one snapshot."""
    now = utc_now()
    for project in session.scalars(select(ProjectRow)):
        labels = labels_of(session, project.id)
        _check_labels(project, labels)
        _check_counters(session, project, labels)
        _check_leases(session, project, labels, now)
        _check_rounds(session, project)
    _check_once(session)


def labels_of(session: Session, project: UUID) -> list[LabelRow]:
    """All labels of a project by watermark."""
    return list(session.scalars(select(LabelRow).where(LabelRow.project_id == project).order_by(LabelRow.watermark)))


def segments_of(labels: list[LabelRow]) -> Counter[Segment]:
    """How often each segment is labeled."""
    return Counter((row.trajectory_id, row.start) for row in labels)


def repeated(counts: Mapping[Any, int]) -> list[Any]:
    """What was counted more than once."""
    return [key for key, count in counts.items() if count > 1]


def _check_labels(project: ProjectRow, labels: list[LabelRow]) -> None:
    assert repeated(segments_of(labels)) == [], f"segments of {project.name} that are labeled twice"
    watermarks = [row.watermark for row in labels]
    assert watermarks == list(range(1, len(labels) + 1)), f"watermarks of {project.name} with gaps"
    assert project.label_watermark == len(labels), f"{project.name}: {len(labels)} labels"


def _check_counters(session: Session, project: ProjectRow, labels: list[LabelRow]) -> None:
    """The counters in the project's row, beside what they count."""
    members = session.scalars(select(MembershipRow).where(MembershipRow.project_id == project.id)).all()
    for split in ("pool", "held_out"):
        found = [row for row in members if row.split == split]
        counted = (len(found), sum(row.segments for row in found), sum(label.split == split for label in labels))
        kept = tuple(getattr(project, f"{split}_{what}") for what in ("trajectories", "segments", "labels"))
        assert kept == counted, f"{project.name}: counters of {split} are {kept}, the rows say {counted}"


def _check_leases(session: Session, project: ProjectRow, labels: list[LabelRow], now: datetime) -> None:
    """Live leases share no segment, claims are what of them is open, the budget holds, a segment is one thing."""
    of_project = AcquisitionRow.project_id == project.id
    live = select(AcquisitionRow.id).where(
        of_project, AcquisitionRow.status == "leased", AcquisitionRow.lease_expires_at > now
    )
    items = select(AcquisitionItemRow).where(
        AcquisitionItemRow.acquisition_id.in_(live), AcquisitionItemRow.actions.is_(None)
    )
    given = Counter((row.trajectory_id, row.start) for row in session.scalars(items))
    assert repeated(given) == [], f"segments of {project.name} in two live leases"
    rows = session.scalars(select(ClaimRow).where(ClaimRow.project_id == project.id, ClaimRow.expires_at > now)).all()
    claims = {(row.trajectory_id, row.start) for row in rows if row.purpose != "explore"}
    labeled = set(segments_of(labels))
    assert claims == set(given) - labeled, f"{project.name}: claims that are not the open items of live leases"
    tokens = session.scalars(select(AcquisitionRow.token).where(of_project)).all()
    assert repeated(Counter(tokens)) == [], f"a lease token of {project.name} was given twice"
    assert project.token >= max(tokens, default=0)
    _check_budget(project, labels, rows)
    _check_pool(session, project, labeled, claims)


def _check_budget(project: ProjectRow, labels: list[LabelRow], claims: Any) -> None:
    total = policy_of(project).label_budget
    spent = sum(row.split == "pool" for row in labels)
    reserved = sum(row.purpose != "held_out" for row in claims)
    assert total is None or spent + reserved <= total, f"{project.name}: {spent} + {reserved} of {total} labels"


def _check_pool(session: Session, project: ProjectRow, labeled: set[Segment], claims: set[Segment]) -> None:
    """Segments are unlabeled, leased or labeled: the sets are apart, and all of them are segments of members."""
    members = session.scalars(select(MembershipRow).where(MembershipRow.project_id == project.id))
    segments = {(row.trajectory_id, number * project.stride) for row in members for number in range(row.segments)}
    assert labeled <= segments, f"labels of {project.name} on what is no segment"
    assert claims <= segments - labeled, f"leases of {project.name} on what is labeled or no segment"
    queue = select(QueueRow.scoring_id, QueueRow.trajectory_id, QueueRow.start).where(QueueRow.project_id == project.id)
    rows = [tuple(row) for row in session.execute(queue)]
    assert repeated(Counter(rows)) == [], f"segments of {project.name} twice in a queue"
    assert {(trajectory, start) for _, trajectory, start in rows} <= segments


def _check_rounds(session: Session, project: ProjectRow) -> None:
    rounds = session.scalars(select(RoundRow).where(RoundRow.project_id == project.id)).all()
    assert repeated(Counter(row.number for row in rounds)) == []
    finished = [row for row in rounds if row.status in ("current", "superseded")]
    assert [row.status for row in finished].count("current") == min(1, len(finished)), f"rounds of {project.name}"
    for row in rounds:
        names = [stage["name"] for stage in row.stages if isinstance(stage, dict)]
        assert len(names) == len(set(names)), f"round {row.number} of {project.name} did a stage twice: {names}"


def _check_once(session: Session) -> None:
    """No network is registered twice, no job is done twice."""
    stages = select(ModelVersionRow.round_id, ModelVersionRow.kind, ModelVersionRow.member)
    rows = session.execute(stages.where(ModelVersionRow.round_id.is_not(None)))
    assert repeated(Counter(map(tuple, rows))) == [], "two model versions of one stage"
    done = [event.data["job"] for event in session.scalars(select(EventRow).where(EventRow.kind == "job.done"))]
    assert repeated(Counter(done)) == [], "jobs that were done twice"
    for job in session.scalars(select(JobRow).where(JobRow.state.in_(("done", "failed", "cancelled")))):
        assert job.finished_at is not None, f"job {job.id} is {job.state} and not finished"
        assert job.owner is None, f"job {job.id} is {job.state} and still has an owner"
