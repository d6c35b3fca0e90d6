"""Viewpoints of the page that shows a result."""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Add the column."""
    op.add_column("jobs", sa.Column("viewpoints", sa.JSON(), nullable=True))
