"""Policies: what collections can roll out besides the simulators' own behaviors.

Revision ID: 0010
Revises: 0009
"""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "policy",
        sa.Column("project_id", sa.Uuid(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("training_id", sa.Uuid(), nullable=False),
        sa.Column("observations", sa.String(length=10), nullable=False),
        sa.Column("stage", sa.Integer(), nullable=False),
        sa.Column("stages", sa.Integer(), nullable=False),
        sa.Column("steps", sa.Integer(), nullable=False),
        sa.Column("success", sa.Double(), nullable=False),
        sa.Column("episodes", sa.Integer(), nullable=False),
        sa.Column("bytes", sa.Integer(), nullable=False),
        sa.Column("state_sha256", sa.String(length=64), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name=op.f("fk_policy_project_id_project")),
        sa.PrimaryKeyConstraint("project_id", "sha256", name=op.f("pk_policy")),
    )
    op.create_index("ix_policy_sha256", "policy", ["sha256"])
    op.create_index(op.f("ix_policy_training_id"), "policy", ["training_id"])


def downgrade() -> None:
    """An older service cannot read jobs that train them."""
    op.execute("DELETE FROM job WHERE kind = 'train_policy'")
    op.drop_table("policy")
