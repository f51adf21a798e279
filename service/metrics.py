"""What Prometheus is told of the work. It is read from the database, so whichever process is asked says the same."""

from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

from prometheus_client import CollectorRegistry, Gauge
from sqlalchemy.orm import Session

from service import canary, projects, rounds, scorings
from service.store.queries import jobs as job_queries
from service.store.queries import measures
from service.store.queries import pool as pool_queries
from service.store.queries.acquisitions import newest_scoring
from service.store.tables import ProjectRow

SEGMENT_STATES = ("unlabeled", "leased", "labeled")
MEASURES = ("loss", "exact_accuracy", "dynamics_accuracy", "inverse_accuracy")


def gauges(session: Session, now: datetime) -> CollectorRegistry:
    """All of them as they are now. Times are seconds."""
    registry = CollectorRegistry()
    rows = pool_queries.projects_in_order(session)
    names = {row.id: row.name for row in rows}
    _jobs(registry, session, now)
    _leases(registry, session, now, names)
    _rounds(registry, session, names)
    _projects(registry, session, now, rows)
    return registry


def _jobs(registry: CollectorRegistry, session: Session, now: datetime) -> None:
    jobs = Gauge("asim_jobs", "Jobs by queue and state", ["queue", "state"], registry=registry)
    for queue, state, count in job_queries.counts_by_state(session):
        jobs.labels(queue, state).set(count)
    depth = Gauge("asim_queue_depth", "Jobs that wait for a worker", ["queue"], registry=registry)
    age = Gauge("asim_queue_age_seconds", "Since the oldest waiting job was asked for", ["queue"], registry=registry)
    waiting = measures.waiting_jobs(session, now)
    for queue in canary.QUEUES:
        oldest = waiting.get(queue, measures.Oldest(0, now))
        depth.labels(queue).set(oldest.number)
        age.labels(queue).set((now - oldest.since).total_seconds())
    ages = Gauge("asim_canary_age_seconds", "Since a queue's canary was last done", ["queue"], registry=registry)
    for queue, seconds in canary.ages(session, now).items():
        if seconds is not None:
            ages.labels(queue).set(seconds)
    workers = Gauge("asim_workers", "Workers heard of lately", registry=registry)
    workers.set(job_queries.live_workers(session, now - canary.WORKER_SILENCE))


def _leases(registry: CollectorRegistry, session: Session, now: datetime, names: dict[UUID, str]) -> None:
    count = Gauge("asim_leases", "Batches under a live lease", ["project"], registry=registry)
    age = Gauge("asim_lease_age_seconds", "Since the oldest live lease was given", ["project"], registry=registry)
    live = measures.open_leases(session, now)
    for project, name in names.items():
        oldest = live.get(project, measures.Oldest(0, now))
        count.labels(name).set(oldest.number)
        age.labels(name).set((now - oldest.since).total_seconds())


def _rounds(registry: CollectorRegistry, session: Session, names: dict[UUID, str]) -> None:
    found = Gauge("asim_rounds", "Rounds by status", ["project", "status"], registry=registry)
    for project, status, count in measures.rounds_by_status(session):
        if project in names:  # else it was made since they were read
            found.labels(names[project], status).set(count)


def _projects(registry: CollectorRegistry, session: Session, now: datetime, rows: Sequence[ProjectRow]) -> None:
    segments = Gauge("asim_segments", "Pool segments by state", ["project", "state"], registry=registry)
    held_out = Gauge("asim_held_out_labels", "Labeled held-out segments", ["project"], registry=registry)
    ranked = Gauge("asim_ranked_segments", "Ready to be acquired by the policy", ["project"], registry=registry)
    rate = Gauge("asim_scoring_rate", "Segments scored a second of work, lately", ["project"], registry=registry)
    labels = Gauge("asim_model_labels", "Labels that the newest evaluated round saw", ["project"], registry=registry)
    errors = {
        name: Gauge(f"asim_model_error_{name}", "On held-out labels, newest round", ["project"], registry=registry)
        for name in MEASURES
    }
    for row in rows:
        counts = projects.describe(session, row, now).counts
        for state in SEGMENT_STATES:
            segments.labels(row.name, state).set(getattr(counts, state))
        held_out.labels(row.name).set(counts.held_out_labeled)
        ranked.labels(row.name).set(_ranked(session, row, now))
        speed = measures.scoring_rate(session, row.id)
        if speed is not None:
            rate.labels(row.name).set(speed)
        points = rounds.curve(session, row).points
        if points:
            labels.labels(row.name).set(points[-1].labels)
            for name, gauge in errors.items():
                value = getattr(points[-1].model_error, name)
                if value is not None:
                    gauge.labels(row.name).set(value)


def _ranked(session: Session, row: ProjectRow, now: datetime) -> int:
    """Under the project's own strategy, by the newest queue that is ready."""
    strategy, current = scorings.ranking(session, row, projects.policy_of(row).strategy)
    scoring = newest_scoring(session, row.id, strategy, current.id if current else None, "ready")
    return 0 if scoring is None else measures.ranked(session, scoring, now)
