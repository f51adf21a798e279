"""a service to trust: counters, idempotency, who did what, explore items, canaries"""

import sqlalchemy as sa
from alembic import op

import service.store.columns

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

COUNTERS = ("pool_trajectories", "pool_segments", "held_out_trajectories", "held_out_segments", "held_out_labels")
TEXTS = (
    ("event", "actor", 200),
    ("event", "correlation", 100),
    ("job", "correlation", 100),
    ("acquisition", "mode", 10),
)


def upgrade() -> None:
    op.create_table(
        "idempotency",
        sa.Column("caller", sa.String(length=40), nullable=False),
        sa.Column("route", sa.String(length=40), nullable=False),
        sa.Column("key", sa.String(length=200), nullable=False),
        sa.Column("request_sha256", sa.String(length=64), nullable=False),
        sa.Column("status", sa.Integer(), nullable=True),
        sa.Column("location", sa.String(length=200), nullable=True),
        sa.Column("body", sa.String(), nullable=True),
        sa.Column("expires_at", service.store.columns.UtcDateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("caller", "route", "key", name=op.f("pk_idempotency")),
    )
    op.create_index(op.f("ix_idempotency_expires_at"), "idempotency", ["expires_at"])
    op.create_index("ix_acquisition_expiry", "acquisition", ["status", "lease_expires_at"])
    op.create_index("ix_membership_split", "membership", ["project_id", "split", "id"])
    _add_nullable()
    _fill()
    _tighten()


def downgrade() -> None:
    op.execute("DELETE FROM job WHERE project_id IS NULL")
    op.execute("DELETE FROM claim WHERE purpose = 'explore'")
    op.execute(
        "DELETE FROM acquisition_item WHERE acquisition_id IN (SELECT id FROM acquisition WHERE mode = 'explore')"
    )
    op.execute("DELETE FROM acquisition WHERE mode = 'explore'")
    op.execute("UPDATE acquisition SET status = 'leased' WHERE status = 'expired'")
    op.execute("UPDATE job SET state = 'failed' WHERE state = 'cancelled'")
    op.execute("UPDATE round SET status = 'failed' WHERE status = 'cancelled'")
    with op.batch_alter_table("job") as table:
        table.alter_column("project_id", existing_type=sa.Uuid(), nullable=False)
        table.drop_column("checkpoint_stage")
        table.drop_column("correlation")
    with op.batch_alter_table("event") as table:
        for name in ("transaction", "actor", "correlation"):
            table.drop_column(name)
    with op.batch_alter_table("acquisition_item") as table:
        table.drop_column("answer")
        table.drop_column("actions")
    with op.batch_alter_table("acquisition") as table:
        table.drop_column("reason")
        table.drop_column("mode")
    with op.batch_alter_table("queue") as table:
        table.drop_column("leased_until")
    with op.batch_alter_table("project") as table:
        for name in COUNTERS:
            table.drop_column(name)
    op.drop_index("ix_acquisition_expiry", table_name="acquisition")
    op.drop_index("ix_membership_split", table_name="membership")
    op.drop_index(op.f("ix_idempotency_expires_at"), table_name="idempotency")
    op.drop_table("idempotency")


def _add_nullable() -> None:
    for name in COUNTERS:
        op.add_column("project", sa.Column(name, sa.Integer(), nullable=True))
    for table, name, length in TEXTS:
        op.add_column(table, sa.Column(name, sa.String(length=length), nullable=True))
    op.add_column("event", sa.Column("transaction", sa.BigInteger(), nullable=True))
    op.add_column("queue", sa.Column("leased_until", service.store.columns.UtcDateTime(timezone=True), nullable=True))
    op.add_column("acquisition", sa.Column("reason", sa.String(), nullable=True))
    op.add_column("acquisition_item", sa.Column("actions", sa.JSON(none_as_null=True), nullable=True))
    op.add_column("acquisition_item", sa.Column("answer", sa.String(length=64), nullable=True))
    op.add_column("job", sa.Column("checkpoint_stage", sa.String(length=60), nullable=True))


def _fill() -> None:
    """The counters of what is there; whoever did it before is not known."""
    for split in ("pool", "held_out"):
        members = f"FROM membership m WHERE m.project_id = project.id AND m.split = '{split}'"  # our names
        op.execute(f"UPDATE project SET {split}_trajectories = (SELECT count(*) {members})")  # noqa: S608
        op.execute(f"UPDATE project SET {split}_segments = (SELECT coalesce(sum(m.segments), 0) {members})")  # noqa: S608
    labels = "SELECT count(*) FROM label WHERE label.project_id = project.id AND label.split = 'held_out'"
    op.execute(f"UPDATE project SET held_out_labels = ({labels})")  # noqa: S608
    for table, name, _ in TEXTS:
        op.execute(f"UPDATE {table} SET {name} = '{'pool' if name == 'mode' else ''}'")  # noqa: S608
    op.execute('UPDATE event SET "transaction" = 0')


def _tighten() -> None:
    with op.batch_alter_table("project") as table:
        for name in COUNTERS:
            table.alter_column(name, existing_type=sa.Integer(), nullable=False)
    for name, length in (("actor", 200), ("correlation", 100)):
        with op.batch_alter_table("event") as table:
            table.alter_column(name, existing_type=sa.String(length=length), nullable=False)
    with op.batch_alter_table("event") as table:
        table.alter_column("transaction", existing_type=sa.BigInteger(), nullable=False)
    with op.batch_alter_table("acquisition") as table:
        table.alter_column("mode", existing_type=sa.String(length=10), nullable=False)
    with op.batch_alter_table("job") as table:
        table.alter_column("correlation", existing_type=sa.String(length=100), nullable=False)
        table.alter_column("project_id", existing_type=sa.Uuid(), nullable=True)
