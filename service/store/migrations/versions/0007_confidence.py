"""How sure the inverse dynamics was of a ranked segment's actions, in the queue and with what was given out.

Revision ID: 0007
Revises: 0006
"""

import json

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

ANSWER = sa.table("idempotency", *map(sa.column, ("caller", "route", "key", "body")))


def upgrade() -> None:
    for table in ("queue", "acquisition_item"):
        op.add_column(table, sa.Column("confidence", sa.Double(), nullable=True))


def downgrade() -> None:
    """Kept answers to POST /acquire are sent again as they stand: older clients refuse what they do not know."""
    for table in ("queue", "acquisition_item"):
        with op.batch_alter_table(table) as altered:
            altered.drop_column("confidence")
    connection = op.get_bind()
    kept = sa.select(ANSWER).where(ANSWER.c.route == "POST /acquire", ANSWER.c.body.is_not(None))
    for caller, route, key, body in connection.execute(kept).all():
        answer = json.loads(body)
        for item in answer.get("items", []):
            item.pop("confidence", None)
        this = (ANSWER.c.caller == caller, ANSWER.c.route == route, ANSWER.c.key == key)
        connection.execute(sa.update(ANSWER).where(*this).values(body=json.dumps(answer)))
