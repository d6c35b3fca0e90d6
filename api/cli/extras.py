"""Message for commands whose packages an extra of this project installs."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, requires

_PROJECT = "sgsst-service"


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """Return a message about the extra that installs a missing module; None if it belongs to none.

    Modules are named like their packages, with underscores.
    """
    module = (error.name or "").partition(".")[0]
    try:
        requirements = requires(_PROJECT) or ()
    except PackageNotFoundError:
        return None
    for requirement in requirements:
        matched = re.match(r"([\w.-]+).*\bextra == ['\"](\w+)['\"]", requirement)
        if matched and matched[1].lower().replace("-", "_") == module:
            return (
                f"this command needs {matched[1]}, which the extra `{matched[2]}` installs. "
                f"Run `pip install '{_PROJECT}[{matched[2]}]'`."
            )
    return None
