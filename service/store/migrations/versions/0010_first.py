"""Tables of the first version, which new databases get from `service.store.tables` instead."""

revision = "0010"
down_revision = None


def upgrade() -> None:
    """Do nothing: later migrations start here."""
