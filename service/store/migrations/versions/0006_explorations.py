"""Scorings have a mode, and ranked rows may name actions to execute: explorations that a strategy proposes.

Revision ID: 0006
Revises: 0005
"""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("queue", sa.Column("actions", sa.JSON(none_as_null=True), nullable=True))
    op.add_column("scoring", sa.Column("mode", sa.String(length=10), nullable=True))
    op.execute("UPDATE scoring SET mode = 'pool'")
    with op.batch_alter_table("scoring") as table:
        table.alter_column("mode", existing_type=sa.String(length=10), nullable=False)


def downgrade() -> None:
    """Explorations that are not given out yet are proposals only: they go, and so do the jobs that make some."""
    op.execute("DELETE FROM job WHERE kind = 'propose_explorations'")
    op.execute("DELETE FROM queue WHERE actions IS NOT NULL")
    op.execute("DELETE FROM scoring WHERE mode = 'explore'")
    with op.batch_alter_table("scoring") as table:
        table.drop_column("mode")
    with op.batch_alter_table("queue") as table:
        table.drop_column("actions")
