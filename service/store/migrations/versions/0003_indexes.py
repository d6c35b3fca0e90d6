"""Indexes for counting queue positions, and an owner's jobs by status, without reading the rows of jobs."""

from __future__ import annotations

from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Create the indexes."""
    op.drop_index("ix_jobs_queue", "jobs")
    op.create_index("ix_jobs_queue", "jobs", ["status", "priority", "queued_at", "id"], unique=False)
    op.create_index("ix_jobs_owner_status", "jobs", ["owner", "status", "id"], unique=False)


def downgrade() -> None:
    """Restore the previous index, which only finds queued jobs."""
    op.drop_index("ix_jobs_owner_status", "jobs")
    op.drop_index("ix_jobs_queue", "jobs")
    op.create_index("ix_jobs_queue", "jobs", ["status", "not_before"], unique=False)
