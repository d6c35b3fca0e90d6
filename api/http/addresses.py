"""Addresses of the service's resources, below the subpath at which a reverse proxy offers the service.

The subpath is that of the current request: a setting, or what a trusted proxy has sent (`api.http.middleware`).
"""

from __future__ import annotations

from contextvars import ContextVar

from starlette.types import Scope

#: Subpath of the current request, such as "/sgsst"; empty at the root of a host.
subpath: ContextVar[str] = ContextVar("subpath", default="")


def address(path: str) -> str:
    """Return the address, as clients see it, of a path of the API."""
    return subpath.get() + path


def path_of(scope: Scope) -> str:
    """Return the path of a request without the subpath."""
    path: str = scope["path"]
    return path.removeprefix(scope.get("root_path", ""))
