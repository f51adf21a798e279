"""Events are followed in the order of their transactions; the one row of event_epoch keeps these rising.

Revision ID: 0003
Revises: 0002
"""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    epoch = op.create_table(
        "event_epoch",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("added", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_event_epoch")),
    )
    op.bulk_insert(epoch, [{"id": 1, "added": 0}])
    op.drop_index("ix_event_project", table_name="event")
    op.create_index("ix_event_project", "event", ["project_id", "transaction", "id"])
    op.create_index("ix_event_order", "event", ["transaction", "id"])
    op.create_index("ix_job_finished", "job", ["queue", "finished_at"])


def downgrade() -> None:
    op.drop_index("ix_job_finished", table_name="job")
    op.drop_index("ix_event_order", table_name="event")
    op.drop_index("ix_event_project", table_name="event")
    op.create_index("ix_event_project", "event", ["project_id", "id"])
    op.drop_table("event_epoch")
