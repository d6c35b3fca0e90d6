"""Style transfer for 3D Gaussian Splatting scenes: the method, without processes, HTTP or command line."""

from __future__ import annotations

from sgsst_core.camera import Camera
from sgsst_core.scene import Scene
from sgsst_core.settings import Settings, make_settings
from sgsst_core.stylizer import Callbacks, Progress, Stylizer, run, stylize

__all__ = ["Callbacks", "Camera", "Progress", "Scene", "Settings", "Stylizer", "make_settings", "run", "stylize"]
