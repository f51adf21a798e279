"""Keys that reach one project only, and keys that expire.

Revision ID: 0009
Revises: 0008
"""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

KEY = sa.table("api_key", *map(sa.column, ("id", "project_id", "expires_at")))


def upgrade() -> None:
    with op.batch_alter_table("api_key") as altered:
        altered.add_column(sa.Column("project_id", sa.Uuid(), nullable=True))
        altered.add_column(sa.Column("expires_at", sa.DateTime(timezone=True), nullable=True))
        altered.create_foreign_key(op.f("fk_api_key_project_id_project"), "project", ["project_id"], ["id"])


def downgrade() -> None:
    """A key that is limited would reach everything, for ever: it goes."""
    limited = sa.or_(KEY.c.project_id.is_not(None), KEY.c.expires_at.is_not(None))
    op.get_bind().execute(sa.delete(KEY).where(limited))
    with op.batch_alter_table("api_key") as altered:
        altered.drop_constraint(op.f("fk_api_key_project_id_project"), type_="foreignkey")
        altered.drop_column("expires_at")
        altered.drop_column("project_id")
