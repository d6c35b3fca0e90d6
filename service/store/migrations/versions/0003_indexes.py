"""Indexes in which places in the queue, and jobs of an owner by status, are counted without reading the jobs."""

from __future__ import annotations

from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Create them."""
    op.drop_index("ix_jobs_queue", "jobs")
    op.create_index("ix_jobs_queue", "jobs", ["status", "priority", "queued_at", "id"], unique=False)
    op.create_index("ix_jobs_owner_status", "jobs", ["owner", "status", "id"], unique=False)


def downgrade() -> None:
    """Back to an index that only finds what is queued."""
    op.drop_index("ix_jobs_owner_status", "jobs")
    op.drop_index("ix_jobs_queue", "jobs")
    op.create_index("ix_jobs_queue", "jobs", ["status", "not_before"], unique=False)
