"""`python -m service.prepare`: create the database tables and the file bucket that API and dispatchers share.

Run it once per installation, and before the processes of a new version start. Migrations only add to the schema, so
processes of the previous version keep working meanwhile (tests/service/store/test_migrations.py). The command waits
until both the database and the file store respond.
"""

from __future__ import annotations

import sys
import time

from service.files.objects import ObjectStore
from service.problems import DatabaseUnavailableError, StoreError
from service.settings import start
from service.store import open_store
from sgsst_core.errors import SettingsError

_RETRY_SECONDS = 2.0


def main() -> int:
    """Prepare the database and the bucket, and return the exit status: 0 on success."""
    settings = start()
    try:
        open_store(settings, patience=settings.start_seconds).close()
        _make_bucket(ObjectStore(settings.artifacts_url), settings.start_seconds)
    except (DatabaseUnavailableError, StoreError, SettingsError) as error:
        print(f"error: {error}\n{error.__cause__ or ''}", file=sys.stderr)
        return 1
    return 0


def _make_bucket(objects: ObjectStore, patience: float) -> None:
    """Create the bucket, retrying for `patience` seconds while the store does not respond."""
    until = time.monotonic() + patience
    while True:
        try:
            objects.make_bucket()
        except StoreError:
            if time.monotonic() >= until:
                raise
            time.sleep(_RETRY_SECONDS)
        else:
            return


if __name__ == "__main__":
    sys.exit(main())
