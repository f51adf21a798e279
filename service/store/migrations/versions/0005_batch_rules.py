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

PROJECT = sa.table("project", sa.column("id", sa.Uuid()), sa.column("policy", sa.JSON()))


def upgrade() -> None:
    for project, policy in _policies():
        if "diversify" in policy:
            diverse = policy.pop("diversify")
            _write(project, policy | {"batch_rule": "kmeans_plus_plus" if diverse else "top"})


def downgrade() -> None:
    for project, policy in _policies():
        if "batch_rule" in policy:
            rule = policy.pop("batch_rule")
            _write(project, policy | {"diversify": rule != "top"})


def _policies() -> list[tuple[Any, dict[str, Any]]]:
    rows = op.get_bind().execute(sa.select(PROJECT.c.id, PROJECT.c.policy)).all()
    return [(project, dict(policy)) for project, policy in rows]


def _write(project: Any, policy: dict[str, Any]) -> None:
    op.get_bind().execute(sa.update(PROJECT).where(PROJECT.c.id == project).values(policy=policy))
