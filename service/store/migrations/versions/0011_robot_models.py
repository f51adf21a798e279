"""The robot family: presets, networks that go on from those of the round before, coordinates that are signs.

Revision ID: 0011
Revises: 0010
"""

from collections.abc import Callable
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

JSON = sa.JSON(none_as_null=True)
PROJECT = sa.table(
    "project",
    sa.column("id", sa.Uuid()),
    sa.column("family"),
    sa.column("spaces", JSON),
    sa.column("environment", JSON),
)
ROUND = sa.table(
    "round",
    *(sa.column(name, sa.Uuid()) for name in ("id", "project_id")),
    sa.column("status"),
    sa.column("model_error", JSON),
)
JOB = sa.table("job", sa.column("id", sa.Uuid()), sa.column("kind"), sa.column("payload", JSON))
PARENT = "fk_model_version_parent_id_model_version"


def upgrade() -> None:
    with op.batch_alter_table("project") as altered:
        altered.add_column(sa.Column("preset", sa.String(40), nullable=True))
    with op.batch_alter_table("model_version") as altered:
        altered.add_column(sa.Column("parent_id", sa.Uuid(), nullable=True))
        altered.create_foreign_key(op.f(PARENT), "model_version", ["parent_id"], ["id"])


def downgrade() -> None:
    """Older services train nothing on robots, and refuse documents with more in them than they know."""
    with op.batch_alter_table("model_version") as altered:
        altered.drop_constraint(op.f(PARENT), type_="foreignkey")
        altered.drop_column("parent_id")
    with op.batch_alter_table("project") as altered:
        altered.drop_column("preset")
    robots = sa.select(PROJECT.c.id).where(PROJECT.c.family == "robot")
    in_use = ROUND.c.project_id.in_(robots), ROUND.c.status == "current"
    op.get_bind().execute(sa.update(ROUND).where(*in_use).values(status="superseded"))
    op.get_bind().execute(sa.update(PROJECT).where(PROJECT.c.family == "robot").values(family=None))
    _change(PROJECT, PROJECT.c.spaces, _without_signs)
    _change(PROJECT, PROJECT.c.environment, lambda known: known | {"spaces": _without_signs(known.get("spaces"))})
    _change(ROUND, ROUND.c.model_error, lambda error: _without(error, "open_loop"))
    _change(JOB, JOB.c.payload, lambda payload: _without(payload, "memberships"), JOB.c.kind == "train_round")


def _change(table: Any, column: Any, change: Callable[[Any], Any], *of: Any) -> None:
    """Write each of a column's documents anew, of the rows `of` which that is true."""
    connection = op.get_bind()
    for row_id, document in connection.execute(sa.select(table.c.id, column).where(*of)).all():
        if document is not None and change(document) != document:
            connection.execute(sa.update(table).where(table.c.id == row_id).values({column.name: change(document)}))


def _without_signs(spaces: dict[str, Any] | None) -> dict[str, Any] | None:
    return None if spaces is None else spaces | {"actions": _without(spaces["actions"], "signs")}


def _without(document: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in document.items() if key != name}
