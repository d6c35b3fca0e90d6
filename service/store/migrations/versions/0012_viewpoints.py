"""Viewpoints of the page that shows a result."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Add the column."""
    op.add_column("jobs", sa.Column("viewpoints", sa.JSON(), nullable=True))
