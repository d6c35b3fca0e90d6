"""`python -m service.ensure_network_weights`: fetch the smallest network where none is installed, and say so."""

from __future__ import annotations

import sys

from sgsst_core.errors import SgsstError
from sgsst_core.features.network_weights import fetch_network_weights, list_network_weights


def main() -> int:
    """Returns 0 where there is a network at the end."""
    if any(entry.path for entry in list_network_weights() if entry.name in ("vgg19", "vgg16")):
        return 0
    print("No feature network is installed yet: fetching VGG16 (64 MB). `sgsst weights fetch vgg19` gets the paper's.")
    try:
        fetch_network_weights("vgg16")
    except SgsstError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
