"""Features of the service that need an extra of this project."""

from __future__ import annotations

from importlib.util import find_spec

#: Module that each extra installs, and what it is for.
_EXTRAS = {"video": ("av", "Videos"), "heif": ("pillow_heif", "HEIC images")}


def installed_extras() -> dict[str, bool]:
    """Return whether each optional extra is installed."""
    return {extra: find_spec(module) is not None for extra, (module, _) in _EXTRAS.items()}


def missing_extras() -> list[str]:
    """Return a line for the operator about each feature that is not offered, with the command that installs it."""
    missing = [extra for extra, there in installed_extras().items() if not there]
    return [f"{_EXTRAS[each][1]} are not offered. To add them: {install_command(each)}" for each in missing]


def install_command(extra: str) -> str:
    """Return the command that installs an extra."""
    return f"pip install 'sgsst-service[{extra}]'"
