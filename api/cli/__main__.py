"""Entry point of the `sgsst` command and of `python -m api.cli`."""

import atexit
import gc
import sys

from api import installed_version
from api.cli import ABORTED, INTERRUPTED


def run() -> int:
    """Run the command line, and return its exit code. Ctrl-C ends it in one line, also while its imports run."""
    if sys.argv[1:] == ["--version"]:
        print(f"sgsst {installed_version()}")
        return 0
    atexit.register(gc.freeze)  # or the end searches all that was imported for garbage, for half a second
    try:
        from api.cli.main import main
    except KeyboardInterrupt:
        print(ABORTED, file=sys.stderr)
        return INTERRUPTED
    return main()


if __name__ == "__main__":
    raise SystemExit(run())
