"""Style transfer for 3D Gaussian Splatting scenes: the method, without processes, HTTP or command line."""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sgsst_core.scene.camera import Camera
    from sgsst_core.scene.gaussians import Scene
    from sgsst_core.settings import Settings, make_settings
    from sgsst_core.stylizing.loop import Callbacks, Progress, run, stylize
    from sgsst_core.stylizing.stylizer import Stylizer

# PyTorch looks at it once, before its first tensor: memory of two megabytes and more in pages of that size, of which a
# step on a CPU then takes a few thousand and not millions. Linux grants them where it can; elsewhere it does nothing.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")

__all__ = ["Callbacks", "Camera", "Progress", "Scene", "Settings", "Stylizer", "make_settings", "run", "stylize"]

_MODULES = {
    "Callbacks": "stylizing.loop",
    "Camera": "scene.camera",
    "Progress": "stylizing.loop",
    "Scene": "scene.gaussians",
    "Settings": "settings",
    "Stylizer": "stylizing.stylizer",
    "make_settings": "settings",
    "run": "stylizing.loop",
    "stylize": "stylizing.loop",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: PyTorch takes seconds, which `sgsst --help` does without."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
