"""`python -m service.prepare`: create the database tables and the file bucket that API and dispatchers share.

Run it once per installation, and before the processes of a new version start. Migrations only add to the schema, so
processes of the previous version keep working meanwhile (tests/service/store/test_migrations.py). The command waits
until both the database and the file store respond.
"""

from __future__ import annotations

import sys

from service.deadlines import until_answered
from service.files.objects import ObjectStore
from service.problems import DatabaseUnavailableError, StoreError
from service.settings import start
from service.store import open_store
from sgsst_core.errors import SettingsError


def main() -> int:
    """Prepare the database and the bucket, and return the exit status: 0 on success."""
    settings = start()
    try:
        open_store(settings, patience=settings.start_seconds).close()
        until_answered(ObjectStore(settings.artifacts_url).make_bucket, settings.start_seconds)
    except (DatabaseUnavailableError, StoreError, SettingsError) as error:
        print(f"error: {error}\n{error.__cause__ or ''}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
