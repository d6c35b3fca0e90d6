"""Indexes in which the next job is found however long the queue is, and jobs that dispatchers keep room for."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0004"


def upgrade() -> None:
    """Create them."""
    op.create_table(
        "reservations",
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("dispatcher", sa.String(length=120), nullable=False),
        sa.Column("until", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_reservations_job_id"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("job_id", name=op.f("pk_reservations")),
    )
    turns: list[str | sa.TextClause] = ["status", "owner", sa.text("priority DESC"), "queued_at", "id"]
    op.create_index("ix_jobs_turns", "jobs", turns, unique=False)
    op.create_index("ix_jobs_lease_expires_at", "jobs", ["lease_expires_at"], unique=False)


def downgrade() -> None:
    """Dispatchers keep room for nothing."""
    op.drop_index("ix_jobs_lease_expires_at", "jobs")
    op.drop_index("ix_jobs_turns", "jobs")
    op.drop_table("reservations")
