"""Ending rounds whose networks another version of the service cannot read: their labels are due for another round.

As `rounds.fail` and `jobs.cancel` of the service do, but for events, whose form is not the same in all versions.
"""

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa
from alembic import op

PROJECT = sa.table("project", sa.column("id", sa.Uuid()), sa.column("labels_at_round", sa.Integer()))
ROUND = sa.table(
    "round",
    sa.column("id", sa.Uuid()),
    sa.column("project_id", sa.Uuid()),
    sa.column("status"),
    sa.column("error"),
    sa.column("finished_at", sa.DateTime(timezone=True)),
)
MODEL = sa.table("model_version", sa.column("round_id", sa.Uuid()), sa.column("kind"), sa.column("config", sa.JSON()))
SCORING = sa.table(
    "scoring", sa.column("id", sa.Uuid()), sa.column("round_id", sa.Uuid()), sa.column("strategy", sa.String())
)
PARTS = [sa.table(name, sa.column("scoring_id", sa.Uuid())) for name in ("queue", "shard")]
JOB = sa.table(
    "job",
    *(sa.column(name) for name in ("state", "owner", "lease_until", "fence")),
    *(sa.column(name, sa.Uuid()) for name in ("id", "subject_id")),
    sa.column("finished_at", sa.DateTime(timezone=True)),
)
ENDED = "ended by {} of the service, which cannot read its networks: start another round"
AT_ONCE = 500  # ids in a statement


def end_rounds(kind: str, unreadable: Callable[[dict[str, Any]], bool], by: str) -> None:
    """Those with a network of the kind and a config that is unreadable. by: "an upgrade", "a downgrade".

    Weights stay in the blob store.
    """
    models = execute(sa.select(MODEL.c.round_id, MODEL.c.config).where(MODEL.c.kind == kind)).all()
    unread = [round_id for round_id, config in models if round_id is not None and unreadable(config)]
    for start in range(0, len(unread), AT_ONCE):
        _end(unread[start : start + AT_ONCE], ENDED.format(by))


def _end(rounds: list[Any], error: str) -> None:
    current = sa.and_(ROUND.c.id.in_(rounds), ROUND.c.status == "current")
    unfinished = sa.and_(ROUND.c.id.in_(rounds), ROUND.c.status.in_(("queued", "training", "scoring")))
    due = sa.select(ROUND.c.project_id).where(sa.or_(current, unfinished))
    execute(sa.update(PROJECT).where(PROJECT.c.id.in_(due)).values(labels_at_round=0))
    now = datetime.now(UTC)
    execute(sa.update(ROUND).where(unfinished).values(status="failed", error=error, finished_at=now))
    execute(sa.update(ROUND).where(current).values(status="superseded", error=error))
    nobodys = {"state": "cancelled", "owner": None, "lease_until": None, "fence": JOB.c.fence + 1, "finished_at": now}
    alive = (JOB.c.subject_id.in_(rounds), JOB.c.state.in_(("queued", "running")))
    execute(sa.update(JOB).where(*alive).values(nobodys))
    forget_scorings(SCORING.c.round_id.in_(rounds))


def forget_scorings(where: sa.ColumnElement[bool]) -> None:
    """With their queues, and with the jobs that are to do or have done something for them."""
    gone = sa.select(SCORING.c.id).where(where)
    execute(sa.delete(JOB).where(JOB.c.subject_id.in_(gone)))
    for table in PARTS:
        execute(sa.delete(table).where(table.c.scoring_id.in_(gone)))
    execute(sa.delete(SCORING).where(where))


def execute(statement: sa.Executable) -> Any:
    """The rows found, if any; whoever asks knows their columns."""
    return op.get_bind().execute(statement)
