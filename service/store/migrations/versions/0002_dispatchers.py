"""Heartbeats of dispatchers, and columns of jobs for saved steps and for the removal of leftover files."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Add table and columns."""
    op.create_table(
        "dispatchers",
        sa.Column("name", sa.String(length=120), nullable=False),
        sa.Column("seen_at", sa.Float(), nullable=False),
        sa.Column("places", sa.Integer(), nullable=False),
        sa.Column("free", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_dispatchers")),
    )
    op.add_column("jobs", sa.Column("saved_step", sa.Integer(), nullable=True))
    op.add_column("jobs", sa.Column("failed_step", sa.Integer(), nullable=True))
    op.add_column("jobs", sa.Column("swept", sa.Boolean(), nullable=False, server_default=sa.false()))
    op.create_index("ix_jobs_swept", "jobs", ["swept", "status"], unique=False)


def downgrade() -> None:
    """Remove table and columns."""
    op.drop_index("ix_jobs_swept", table_name="jobs")
    for column in ("swept", "failed_step", "saved_step"):
        op.drop_column("jobs", column)
    op.drop_table("dispatchers")
