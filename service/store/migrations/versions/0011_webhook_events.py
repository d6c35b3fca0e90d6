"""Events of a job about which its webhook gets messages."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    """Add the column, and an index for finding a job's messages."""
    op.add_column("jobs", sa.Column("webhook_events", sa.JSON(), nullable=True))
    op.create_index("ix_deliveries_job_id", "deliveries", ["job_id"])
