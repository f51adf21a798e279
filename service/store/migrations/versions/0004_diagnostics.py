"""A round keeps the diagnostics of the method; older rounds have none.

Revision ID: 0004
Revises: 0003
"""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

ROUND = sa.table("round", sa.column("id", sa.Uuid()), sa.column("model_error", sa.JSON(none_as_null=True)))


def upgrade() -> None:
    op.add_column("round", sa.Column("diagnostics", sa.JSON(none_as_null=True), nullable=True))


def downgrade() -> None:
    """Older services refuse a model error with more in it than they know."""
    with op.batch_alter_table("round") as table:
        table.drop_column("diagnostics")
    connection = op.get_bind()
    for round_id, error in connection.execute(sa.select(ROUND.c.id, ROUND.c.model_error)).all():
        if error is not None:
            update = sa.update(ROUND).where(ROUND.c.id == round_id).values(model_error=_without_exact(error))
            connection.execute(update)


def _without_exact(error: dict[str, Any]) -> dict[str, Any]:
    """The share of whole observations predicted right came with the diagnostics."""
    groups = {name: _without_exact(group) for name, group in error.get("by_group", {}).items()}
    kept = {name: value for name, value in error.items() if name not in ("exact_accuracy", "by_group")}
    return kept | ({"by_group": groups} if "by_group" in error else {})
