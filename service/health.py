"""`python -m service.health api|dispatcher`: check the process of this container; the exit status is 1 on failure.

A dispatcher has no port to probe. It is healthy if the database has received a heartbeat within the duration of a
lease. It also counts as healthy while the database does not respond, because a restart would only lose the running
jobs.
"""

import os
import sys
import urllib.request
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # avoids the import at run time: the check runs several times a minute
    from service.store import Store

_SECONDS = 8
#: Timeout of each database query in seconds.
_ANSWER_SECONDS = 2.0


def main() -> int:
    """Run the check and return the exit status: 0 if the process is healthy."""
    match sys.argv[1:]:
        case ["api"]:
            url = f"http://127.0.0.1:{os.environ.get('SGSST_PORT', '8000')}/livez"
            try:
                with urllib.request.urlopen(url, timeout=_SECONDS) as answer:
                    return 0 if answer.status == 200 else 1
            except OSError as error:
                print(f"{url}: {error}", file=sys.stderr)
                return 1
        case ["dispatcher"]:
            from service.settings import read_settings
            from service.store import Store

            return 0 if dispatcher_is_healthy(Store(read_settings(), answer_seconds=_ANSWER_SECONDS)) else 1
    print("usage: python -m service.health api|dispatcher", file=sys.stderr)
    return 2


def dispatcher_is_healthy(store: "Store") -> bool:
    """Return whether a dispatcher of this machine or container has sent a heartbeat lately, or the database is down."""
    from service.problems import DatabaseUnavailableError
    from service.scheduling.capacity import is_of_this_machine

    try:
        alive = store.operations.dispatchers()
    except DatabaseUnavailableError as error:
        print(error, file=sys.stderr)
        return True
    return any(is_of_this_machine(row.name) for row in alive)


if __name__ == "__main__":
    sys.exit(main())
