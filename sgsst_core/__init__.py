"""Style transfer for 3D Gaussian Splatting scenes: the method, without processes, HTTP or command line."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sgsst_core.camera import Camera
    from sgsst_core.loop import Callbacks, Progress, run, stylize
    from sgsst_core.scene import Scene
    from sgsst_core.settings import Settings, make_settings
    from sgsst_core.stylizer import Stylizer

__all__ = ["Callbacks", "Camera", "Progress", "Scene", "Settings", "Stylizer", "make_settings", "run", "stylize"]

_MODULES = {
    "Camera": "camera",
    "Scene": "scene",
    "Settings": "settings",
    "Stylizer": "stylizer",
    "make_settings": "settings",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: PyTorch takes seconds, which `sgsst --help` does without."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES.get(name, 'loop')}"), name)
