"""The grid world model copies elements where it wrote all of them anew: one cannot read the other's weights.

Revision ID: 0008
Revises: 0007
"""

from service.store.migrations.rounds import end_rounds

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    end_rounds("world_model", lambda config: "reconstruction" in config, "an upgrade")


def downgrade() -> None:
    end_rounds("world_model", lambda config: "floor" in config, "a downgrade")
