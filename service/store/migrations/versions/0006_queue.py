"""Indexes for finding the next job in a long queue, reservations of dispatchers, and quotas of keys.

The previous version of the service works with these tables too, because all new columns are optional.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """Create tables, columns and indexes."""
    op.create_table(
        "reservations",
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("dispatcher", sa.String(length=120), nullable=False),
        sa.Column("until", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_reservations_job_id"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("job_id", name=op.f("pk_reservations")),
    )
    op.create_table(
        "usage",
        sa.Column("owner", sa.String(length=40), nullable=False),
        sa.Column("day", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("jobs", sa.Integer(), nullable=False),
        sa.Column("gpu_seconds", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("owner", "day", name=op.f("pk_usage")),
    )
    op.add_column("attempts", sa.Column("gpus", sa.Integer(), nullable=False, server_default=sa.text("0")))
    op.add_column("attempts", sa.Column("gpus_since", sa.Float(), nullable=True))
    op.add_column("api_keys", sa.Column("quotas", sa.JSON(), nullable=True))
    turns: list[str | sa.TextClause] = ["status", "owner", sa.text("priority DESC"), "queued_at", "id"]
    op.create_index("ix_jobs_turns", "jobs", turns, unique=False)
    op.create_index("ix_jobs_lease_expires_at", "jobs", ["lease_expires_at"], unique=False)


def downgrade() -> None:
    """Remove tables, columns and indexes."""
    op.drop_column("api_keys", "quotas")
    for column in ("gpus_since", "gpus"):
        op.drop_column("attempts", column)
    op.drop_table("usage")
    op.drop_index("ix_jobs_lease_expires_at", "jobs")
    op.drop_index("ix_jobs_turns", "jobs")
    op.drop_table("reservations")
