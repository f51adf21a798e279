"""A labeling policy names its batch rule, where it said only whether batches are diverse.

Revision ID: 0005
Revises: 0004
"""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

OLDER = ("random", "cycle", "vanilla_cycle", "uncertainty")  # strategies before there were batch rules
INSTEAD = "cycle"
PROJECT = sa.table("project", sa.column("id", sa.Uuid()), sa.column("policy", sa.JSON()))
JOB = sa.table("job", sa.column("id", sa.Uuid()), sa.column("kind", sa.String()), sa.column("payload", sa.JSON()))


def upgrade() -> None:
    for project, policy in _policies():
        if "diversify" in policy:
            diverse = policy.pop("diversify")
            _write(project, policy | {"batch_rule": "kmeans_plus_plus" if diverse else "top"})


def downgrade() -> None:
    """Where a strategy is named that older services do not know, `cycle` takes its place; what it ranked goes.

    Networks that only such a strategy reads are forgotten; their weights stay in the blob store.
    """
    _forget_newer_scorings()
    op.execute("DELETE FROM model_version WHERE kind = 'masked_inverse_dynamics'")
    for name in ("strategy", "requested_strategy"):
        op.execute(f"UPDATE acquisition SET {name} = '{INSTEAD}' WHERE {name} NOT IN {OLDER}")  # noqa: S608  # our names
    for project, policy in _policies():
        if "batch_rule" in policy:
            rule = policy.pop("batch_rule")
            _write(project, policy | {"diversify": rule != "top", "strategy": _older(policy["strategy"])})
    connection = op.get_bind()
    for job, payload in connection.execute(sa.select(JOB.c.id, JOB.c.payload).where(JOB.c.kind == "train_round")).all():
        older = payload | {"strategy": _older(payload["strategy"])}
        connection.execute(sa.update(JOB).where(JOB.c.id == job).values(payload=older))


def _forget_newer_scorings() -> None:
    newer = f"SELECT id FROM scoring WHERE strategy NOT IN {OLDER}"  # noqa: S608  # our names
    op.execute(f"DELETE FROM job WHERE subject_id IN ({newer})")  # noqa: S608
    for table in ("queue", "shard"):
        op.execute(f"DELETE FROM {table} WHERE scoring_id IN ({newer})")  # noqa: S608
    op.execute(f"DELETE FROM scoring WHERE strategy NOT IN {OLDER}")  # noqa: S608


def _older(strategy: str) -> str:
    return strategy if strategy in OLDER else INSTEAD


def _policies() -> list[tuple[Any, dict[str, Any]]]:
    rows = op.get_bind().execute(sa.select(PROJECT.c.id, PROJECT.c.policy)).all()
    return [(project, dict(policy)) for project, policy in rows]


def _write(project: Any, policy: dict[str, Any]) -> None:
    op.get_bind().execute(sa.update(PROJECT).where(PROJECT.c.id == project).values(policy=policy))
