"""Further usage of keys, and keys of operators."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    """Add the columns; processes of the version before do not write them."""
    op.add_column("api_keys", sa.Column("operator", sa.Boolean(), nullable=False, server_default=sa.false()))
    op.add_column("usage", sa.Column("cpu_seconds", sa.Float(), nullable=False, server_default="0"))
    op.add_column("usage", sa.Column("bytes", sa.BigInteger(), nullable=False, server_default="0"))
