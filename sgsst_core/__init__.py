"""Style transfer for 3D Gaussian Splatting scenes: the core library, without command line or HTTP API."""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sgsst_core.files.images import load_image as load_image
    from sgsst_core.files.library import load_cameras as load_cameras
    from sgsst_core.files.library import load_scene as load_scene
    from sgsst_core.files.library import save as save
    from sgsst_core.progress import Progress as Progress
    from sgsst_core.scene.camera import Camera as Camera
    from sgsst_core.scene.gaussians import Scene as Scene
    from sgsst_core.settings import Settings as Settings
    from sgsst_core.settings import make_settings as make_settings
    from sgsst_core.style import Style as Style
    from sgsst_core.stylizing.loop import Callbacks as Callbacks
    from sgsst_core.stylizing.loop import run as run
    from sgsst_core.stylizing.loop import stylize as stylize
    from sgsst_core.stylizing.stylizer import Stylizer as Stylizer

# PyTorch reads this variable once, before it allocates its first tensor. Allocations of 2 MB and more then use huge
# pages, so a step on a CPU touches a few thousand pages instead of millions. Linux provides huge pages if it can; other
# systems ignore the variable.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
# OpenMP (GCC's, which PyTorch brings) reads these when it starts. A thread that waits for others then spins for some
# microseconds, about what waking it takes. The default is milliseconds, in which it keeps a busy processor from the
# threads that it waits for.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
# PyTorch reads this one when it starts CUDA. Views of many sizes would otherwise leave gaps between blocks of memory
# that no later block fits into.
if os.environ.keys().isdisjoint({"PYTORCH_ALLOC_CONF", "PYTORCH_CUDA_ALLOC_CONF", "PYTORCH_HIP_ALLOC_CONF"}):
    os.environ["PYTORCH_ALLOC_CONF"] = "expandable_segments:True"

#: Modules of the exported names.
_MODULES = {
    "Callbacks": "stylizing.loop",
    "Camera": "scene.camera",
    "Progress": "progress",
    "Scene": "scene.gaussians",
    "Settings": "settings",
    "Style": "style",
    "Stylizer": "stylizing.stylizer",
    "load_cameras": "files.library",
    "load_image": "files.images",
    "load_scene": "files.library",
    "make_settings": "settings",
    "run": "stylizing.loop",
    "save": "files.library",
    "stylize": "stylizing.loop",
}
__all__ = [*_MODULES]


def __getattr__(name: str) -> Any:
    """Import exported names on first access: PyTorch takes seconds to import, and `sgsst --help` does not need it."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
