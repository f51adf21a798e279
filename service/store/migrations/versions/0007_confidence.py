"""How sure the inverse dynamics was of a ranked segment's actions, in the queue and with what was given out.

Revision ID: 0007
Revises: 0006
"""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for table in ("queue", "acquisition_item"):
        op.add_column(table, sa.Column("confidence", sa.Double(), nullable=True))


def downgrade() -> None:
    for table in ("queue", "acquisition_item"):
        with op.batch_alter_table(table) as altered:
            altered.drop_column("confidence")
