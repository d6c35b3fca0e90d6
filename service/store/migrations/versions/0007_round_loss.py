"""Loss of the last round of views in points of the loss history.

The previous version of the service works with these tables too, because all new columns are optional.
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    """Add columns."""
    op.add_column("progress_points", sa.Column("mean_loss", sa.Float(), nullable=True))
    op.add_column("progress_points", sa.Column("mean_scales", sa.JSON(), nullable=True))


def downgrade() -> None:
    """Remove columns."""
    for column in ("mean_scales", "mean_loss"):
        op.drop_column("progress_points", column)
