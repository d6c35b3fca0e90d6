"""`python -m service.prepare`: create the database tables and the file bucket that API and dispatchers share.

Run it once per installation, and before the processes of a new version start. Migrations only add to the schema, so
processes of the previous version keep working meanwhile (tests/service/store/test_migrations.py). The command waits
until both the database and the file store respond.

`python -m service.prepare weights [NAME...]` downloads the named feature networks that this machine lacks instead.
Without names, that is VGG16, but only if neither VGG19 nor VGG16 is installed.
"""

import sys
from collections.abc import Sequence

from service.deadlines import until_answered
from service.files.objects import ObjectStore
from service.settings import start
from service.store import open_store
from sgsst_core.errors import SgsstError


def main() -> int:
    """Prepare what the arguments name, and return the exit status: 0 on success."""
    try:
        if sys.argv[1:2] == ["weights"]:
            _fetch_weights(sys.argv[2:])
        else:
            settings = start()
            open_store(settings, patience=settings.start_seconds).close()
            until_answered(ObjectStore(settings.artifacts_url).make_bucket, settings.start_seconds)
    except SgsstError as error:
        print(f"error: {error}\n{error.__cause__ or ''}", file=sys.stderr)
        return 1
    return 0


def _fetch_weights(wanted: Sequence[str]) -> None:
    from sgsst_core.features.network_weights import fetch_network_weights, list_network_weights

    installed = {entry.name for entry in list_network_weights() if entry.path}
    if not wanted and not installed & {"vgg19", "vgg16"}:
        print("No feature network is installed yet: `sgsst weights fetch vgg19` gets the paper's.")
        wanted = ["vgg16"]
    for name in wanted:
        if name not in installed:
            print(f"Fetching {name}.")
            fetch_network_weights(name)


if __name__ == "__main__":
    sys.exit(main())
