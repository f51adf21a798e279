"""The check of the invariants sees the damage that the crash tests look for."""

from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import copytree

import pytest
from sqlalchemy import delete, select, update

from service.store.tables import (
    AcquisitionItemRow,
    AcquisitionRow,
    ClaimRow,
    EventRow,
    JobRow,
    LabelRow,
    ProjectRow,
    QueueRow,
)
from tests.loop.invariants import check_invariants
from tests.loop.rows import Segment
from tests.workers.conftest import open_loop
from tests.workers.in_process import Loop


@pytest.fixture
def rested(prepared_folder: Path, tmp_path: Path) -> Iterator[Loop]:
    """Labels, and two batches under live leases."""
    copytree(prepared_folder, tmp_path / "data")
    loop = open_loop(tmp_path / "data")
    loop.acquire(3)
    loop.acquire(2)
    yield loop
    loop.close()


def acknowledged(loop: Loop) -> list[Segment]:
    return [(label.trajectory, label.start) for label in loop.client.labels(loop.project.id)]


def lose_a_label(loop: Loop) -> None:
    with loop.worker.database.write() as session:
        newest = session.scalars(select(LabelRow).order_by(LabelRow.watermark.desc())).first()
        session.delete(newest)


def free_a_leased_segment(loop: Loop) -> None:
    with loop.worker.database.write() as session:
        session.execute(delete(ClaimRow))


def give_a_segment_twice(loop: Loop) -> None:
    with loop.worker.database.write() as session:
        live = select(AcquisitionRow.id).where(AcquisitionRow.status == "leased").order_by(AcquisitionRow.token)
        first, second = (session.get_one(AcquisitionItemRow, (key, 0)) for key in session.scalars(live).all())
        second.trajectory_id, second.start = first.trajectory_id, first.start


def fail_a_job(loop: Loop) -> None:
    with loop.worker.database.write() as session:
        session.execute(update(JobRow).values(state="failed"))


def tear_a_blob(loop: Loop) -> None:
    path = next(path for path in (loop.folder / "blobs" / "trajectories").rglob("*/*"))
    path.write_bytes(path.read_bytes()[:-1])


def miscount_the_pool(loop: Loop) -> None:
    with loop.worker.database.write() as session:
        session.execute(update(ProjectRow).values(pool_segments=ProjectRow.pool_segments + 1))


def skip_a_watermark(loop: Loop) -> None:
    with loop.worker.database.write() as session:
        newest = session.scalars(select(LabelRow).order_by(LabelRow.watermark.desc())).first()
        assert newest is not None
        newest.watermark += 1


def overspend(loop: Loop) -> None:
    spent = loop.project.budget.spent
    loop.change(label_budget=spent + 4)  # five more are reserved


def do_a_job_twice(loop: Loop) -> None:
    with loop.worker.database.write() as session:
        done = session.scalars(select(EventRow).where(EventRow.kind == "job.done")).first()
        assert done is not None
        session.add(EventRow(project_id=done.project_id, kind=done.kind, data=done.data, created_at=done.created_at))


def queue_a_segment_twice(loop: Loop) -> None:
    with loop.worker.database.write() as session:
        first, second = session.scalars(select(QueueRow).order_by(QueueRow.rank).limit(2))
        second.trajectory_id, second.start = first.trajectory_id, first.start


def nothing_of_importance(loop: Loop) -> None:
    with loop.worker.database.write() as session:
        session.execute(delete(QueueRow))


def test_a_folder_at_rest_passes(rested: Loop) -> None:
    nothing_of_importance(rested)
    check_invariants(rested.client, rested.folder, acknowledged(rested))


def test_a_label_that_nobody_was_told_of_is_seen_where_all_were_told(rested: Loop) -> None:
    told = acknowledged(rested)
    check_invariants(rested.client, rested.folder, {rested.project.id: told}, exact=True)
    with pytest.raises(AssertionError, match="never acknowledged"):
        check_invariants(rested.client, rested.folder, told[:-1], exact=True)


def test_a_job_may_have_failed_where_that_was_to_be_expected(rested: Loop) -> None:
    told = acknowledged(rested)
    fail_a_job(rested)
    every = [job.id for job in rested.client.jobs(rested.project.id)]
    check_invariants(rested.client, rested.folder, told, ended=every)


DAMAGE = (
    lose_a_label,
    free_a_leased_segment,
    give_a_segment_twice,
    fail_a_job,
    tear_a_blob,
    miscount_the_pool,
    skip_a_watermark,
    overspend,
    do_a_job_twice,
    queue_a_segment_twice,
)


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_seen(rested: Loop, damage: Callable[[Loop], None]) -> None:
    told = acknowledged(rested)
    damage(rested)
    with pytest.raises(AssertionError):
        check_invariants(rested.client, rested.folder, told)
