"""Request of a job's user to end the job early and keep its result.

The previous version of the service works with this table too: it ignores the column, which has a default.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """Add the column."""
    op.add_column("jobs", sa.Column("finish_requested", sa.Boolean(), server_default=sa.false(), nullable=False))


def downgrade() -> None:
    """Remove the column."""
    op.drop_column("jobs", "finish_requested")
