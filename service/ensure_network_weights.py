"""`python -m service.ensure_network_weights [NAME...]`: download the named feature networks that are not installed.

If no names are given, VGG16 is downloaded, but only if neither VGG19 nor VGG16 is installed.
"""

from __future__ import annotations

import sys

from sgsst_core.errors import SgsstError
from sgsst_core.features.network_weights import fetch_network_weights, list_network_weights


def main() -> int:
    """Fetch the networks and return the exit status: 0 on success."""
    installed = {entry.name for entry in list_network_weights() if entry.path}
    wanted = sys.argv[1:]
    if not wanted and not installed & {"vgg19", "vgg16"}:
        print("No feature network is installed yet: `sgsst weights fetch vgg19` gets the paper's.")
        wanted = ["vgg16"]
    for name in wanted:
        if name in installed:
            continue
        print(f"Fetching {name}.")
        try:
            fetch_network_weights(name)
        except SgsstError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
