"""The service's answers as tables for a terminal."""

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from uuid import UUID

from rich.console import Console
from rich.table import Table

from api_schemas.acquisitions import Acquisition
from api_schemas.events import Event
from api_schemas.jobs import Job
from api_schemas.keys import Key
from api_schemas.policies import Policy
from api_schemas.projects import Project
from api_schemas.rounds import ModelErrorCurve, Round
from asim import measures

WIDTH_WITHOUT_TERMINAL = 200
TEXT = ("id", "trajectory", "environment", "strategy", "actions", "kind", "state", "message", "error")

STANDING_STILL = (
    "not foreseen: of what changes in whole segments after their first observation; on the right, squared errors over "
    "all their steps, of images per pixel in [0, 1] / those of a prediction that nothing moves"
)


def show(table: Table) -> None:
    """Print it; without a terminal, wide enough for a log."""
    console = Console()
    wide = console if console.is_terminal else Console(width=WIDTH_WITHOUT_TERMINAL)
    wide.print(table, markup=False)  # what users typed may hold brackets


def project_table(projects: Sequence[Project]) -> Table:
    """One row a project."""
    table = _table("project", "id", "environment", "strategy", "pool", "labeled", "held-out labeled", "budget left")
    for project in projects:
        counts, left = project.counts, project.budget.remaining
        environment = project.environment.simulator or "own spaces"
        budget = "no limit" if left is None else str(left)
        numbers = [str(counts.pool_segments), str(counts.labeled), str(counts.held_out_labeled), budget]
        table.add_row(project.name, str(project.id), environment, project.policy.strategy, *numbers)
    return table


def acquisition_table(acquisition: Acquisition) -> Table:
    """One row a segment, best first; of an exploration, the actions to execute instead of a score."""
    explores = acquisition.mode == "explore"
    table = _table("rank", "trajectory", "start", "length", *(("actions",) if explores else ("score", "confidence")))
    for item in acquisition.items:
        score = "" if item.score is None else f"{item.score:.4f}"
        confidence = "" if item.confidence is None else f"{item.confidence:.0%}"
        last = (json.dumps(item.actions),) if explores else (score, confidence)
        table.add_row(str(item.rank), item.trajectory, str(item.start), str(item.length), *last)
    return table


def job_table(jobs: Sequence[Job]) -> Table:
    """One row a job."""
    table = _table("job", "kind", "state", "attempts", "progress", "message", "error")
    for job in jobs:
        attempts = f"{job.attempts} of {job.max_attempts}"
        table.add_row(str(job.id), job.kind, job.state, attempts, f"{job.progress:.0%}", job.message, job.error or "")
    return table


def policy_table(policies: Sequence[Policy]) -> Table:
    """One row a policy."""
    table = _table("stage", "id", "observations", "steps", "success", "episodes")
    for policy in policies:
        stage = f"{policy.stage + 1} of {policy.stages}"
        numbers = [str(policy.steps), f"{policy.success:.0%}", str(policy.episodes)]
        table.add_row(stage, policy.id, policy.observations, *numbers)
    return table


def key_table(keys: Sequence[Key], projects: Mapping[UUID, str], now: datetime) -> Table:
    """One row a key. projects: their names by id."""
    table = _table("key", "id", "scopes", "project", "expires", "created")
    for key in keys:
        expires = "never" if key.expires_at is None else f"{key.expires_at.astimezone(UTC):%Y-%m-%d %H:%M}Z"
        expired = " (expired)" if key.expires_at is not None and key.expires_at <= now else ""
        created = f"{key.created_at.astimezone(UTC):%Y-%m-%d %H:%M}Z"
        of = "all" if key.project is None else projects[key.project]
        table.add_row(key.name, str(key.id), ", ".join(key.scopes), of, expires + expired, created)
    return table


def event_line(event: Event) -> str:
    """Time, who, what, and what there is to know about it, on one line."""
    moment = event.created_at.astimezone(UTC)
    return _printable(
        f"{moment:%Y-%m-%d %H:%M:%S}Z {event.actor or '-'} {event.kind} {json.dumps(event.data, ensure_ascii=False)}"
    )


def warning_lines(name: str, shown: Round) -> list[str]:
    """What the diagnostics of the project's round warn of, one line each; none where nothing is wrong or was looked at.

    name: of the project.
    """
    warnings = [] if shown.diagnostics is None else shown.diagnostics.warnings
    return [_printable(f"{name}, round {shown.number}: {sentence}") for sentence in warnings]


def error_table(curves: Mapping[str, ModelErrorCurve], first_column: str = "project") -> Table:
    """One row a round: loss (of grids nats a transition, of robots the share of what changes that is not foreseen),
    Dynamics Accuracy overall and by action group, and of robots the open-loop error over whole segments by stream."""
    errors = measures.errors_of(curves)
    open_loop = measures.open_loop(errors)
    columns = [*measures.losses(errors), measures.ACCURACY, *measures.groups(errors), *open_loop]
    table = _table(first_column, "labels", *(column.title for column in columns))
    if open_loop:
        table.caption, table.caption_justify = STANDING_STILL, "left"
    for name, curve in curves.items():
        for point in curve.points:
            cells = (column.told(point.model_error) for column in columns)
            table.add_row(name, str(point.labels), *cells, end_section=point is curve.points[-1])
    return table


def _printable(line: str) -> str:
    """What users typed may hold control characters; a terminal would obey them."""
    return "".join(each if each.isprintable() else f"\\u{ord(each):04x}" for each in line)


def _table(first: str, *others: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column(first, overflow="fold")
    for name in others:
        text = name in TEXT
        table.add_column(
            name, justify="left" if text else "right", overflow="fold", no_wrap=name in ("id", "trajectory")
        )
    return table
