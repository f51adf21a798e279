"""The story of a service twice: as /metrics tells it, and counted from the rows by this module's own statements."""

from collections import Counter
from datetime import datetime

import httpx
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.store.tables import AcquisitionRow, JobRow, LabelRow, MembershipRow, ProjectRow, RoundRow
from tests.loop.processes import eventually
from tests.loop.rows import snapshot

Story = dict[tuple[str, ...], float]
TOLD = ("asim_jobs", "asim_segments", "asim_leases", "asim_rounds", "asim_queue_depth", "asim_model_error_loss")


def check_same_story(url: str, key: str, database_url: str) -> Story:
    """Both tell the same at one moment: rows change in between, so it is looked at until they do."""
    seen: list[tuple[Story, Story]] = []

    def same() -> bool:
        with snapshot(database_url) as session:
            counted = of_rows(session, datetime.now().astimezone())
        told = scraped(url, key)
        seen.append(({name: value for name, value in told.items() if name[0] in TOLD and value}, counted))
        return seen[-1][0] == seen[-1][1]

    eventually(same, 20, lambda: f"{seen[-1][0]} is told, {seen[-1][1]} is counted")
    return seen[-1][0]


def scraped(url: str, key: str) -> Story:
    """Samples by name and the values of their labels."""
    answer = httpx.get(f"{url}/metrics", headers={"Authorization": f"Bearer {key}"}, trust_env=False)
    assert answer.status_code == 200, answer.text
    return {
        (sample.name, *(value for _, value in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def of_rows(session: Session, now: datetime) -> Story:
    """What is not zero, from plain rows."""
    jobs = [row for row in session.scalars(select(JobRow)) if row.kind != "canary"]
    story: Story = {("asim_jobs", *key): n for key, n in Counter((row.queue, row.state) for row in jobs).items()}
    waits = [row for row in jobs if row.state == "queued" and (row.not_before is None or row.not_before <= now)]
    story |= {("asim_queue_depth", queue): n for queue, n in Counter(row.queue for row in waits).items()}
    for project in session.scalars(select(ProjectRow)):
        story |= _of_project(session, project, now)
    return {name: value for name, value in story.items() if value}


def _of_project(session: Session, project: ProjectRow, now: datetime) -> Story:
    def rows(kind: type[AcquisitionRow] | type[LabelRow] | type[RoundRow] | type[MembershipRow]) -> list[object]:
        return list(session.scalars(select(kind).where(kind.project_id == project.id)))

    leases = [row for row in rows(AcquisitionRow) if isinstance(row, AcquisitionRow) and row.status == "leased"]
    leases = [row for row in leases if row.lease_expires_at > now]
    leased = sum(_items(session, row) for row in leases)
    labeled = sum(isinstance(row, LabelRow) and row.split == "pool" for row in rows(LabelRow))
    pool = sum(row.segments for row in rows(MembershipRow) if isinstance(row, MembershipRow) and row.split == "pool")
    rounds = [row for row in rows(RoundRow) if isinstance(row, RoundRow)]
    errors = [row.model_error["loss"] for row in sorted(rounds, key=lambda row: row.number) if row.model_error]
    name = project.name
    return {
        ("asim_leases", name): len(leases),
        ("asim_segments", name, "leased"): leased,
        ("asim_segments", name, "labeled"): labeled,
        ("asim_segments", name, "unlabeled"): pool - labeled - leased,
        **{("asim_rounds", name, status): n for status, n in Counter(row.status for row in rounds).items()},
        **({("asim_model_error_loss", name): float(str(errors[-1]))} if errors else {}),
    }


def _items(session: Session, row: AcquisitionRow) -> int:
    from service.store.tables import AcquisitionItemRow

    items = select(AcquisitionItemRow).where(AcquisitionItemRow.acquisition_id == row.id)
    return len(session.scalars(items).all())
