"""A round keeps the diagnostics of the method; older rounds have none.

Revision ID: 0004
Revises: 0003
"""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("round", sa.Column("diagnostics", sa.JSON(none_as_null=True), nullable=True))


def downgrade() -> None:
    op.drop_column("round", "diagnostics")
