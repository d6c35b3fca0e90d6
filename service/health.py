"""`python -m service.health api|dispatcher`: whether the process of this container works; exit status 1 where not.

A dispatcher has no port. It is well as long as the database has heard of it within a lease's time; where the database
itself does not answer, a restart would only lose the jobs that still run, so that the dispatcher counts as well.
"""

from __future__ import annotations

import os
import sys
import urllib.request
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # asked several times a minute: what is not needed is not imported
    from service.store import Store

_SECONDS = 8
#: Seconds that the database has for each answer.
_ANSWER_SECONDS = 2.0


def main() -> int:
    """Returns 0 where the process is well."""
    match sys.argv[1:]:
        case ["api"]:
            return 0 if _answers(f"http://127.0.0.1:{os.environ.get('SGSST_PORT', '8000')}/livez") else 1
        case ["dispatcher"]:
            from service.settings import ServiceSettings
            from service.store import Store

            return 0 if dispatcher_is_well(Store(ServiceSettings(), answer_seconds=_ANSWER_SECONDS)) else 1
    print("usage: python -m service.health api|dispatcher", file=sys.stderr)
    return 2


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=_SECONDS) as answer:
            return bool(answer.status == 200)
    except OSError as error:
        print(f"{url}: {error}", file=sys.stderr)
        return False


def dispatcher_is_well(store: Store) -> bool:
    """Whether a dispatcher of this machine, or of this container, was heard of lately, or nobody can tell."""
    from service.errors import DatabaseUnavailableError
    from service.scheduling.identity import is_of_this_machine

    try:
        alive = store.operations.dispatchers()
    except DatabaseUnavailableError as error:
        print(error, file=sys.stderr)
        return True
    return any(is_of_this_machine(row.name) for row in alive)


if __name__ == "__main__":
    sys.exit(main())
