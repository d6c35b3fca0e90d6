"""Demo scene without a download: the scene that the page offers as an example, as files for a job.

It was lifted from the stereo pair Motorcycle of the Middlebury 2014 benchmark (Scharstein et al., "High-resolution
stereo datasets with subpixel-accurate ground truth", GCPR 2014): every pixel of the photos became a flat Gaussian.

World: meters, the left camera's axes (x right, y down, z forward), the origin at the left camera.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from api.static_files import FOLDER
from sgsst_core.files.atomic import atomic_path, ensure_writable_folder
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.paintings import STARRY_NIGHT


@dataclass(frozen=True)
class DemoScene:
    """Files of the demo.

    Attributes:
        ply: Scene, a 3DGS PLY of SH degree 0.
        cameras: Views of the scene, an INRIA cameras.json.
        style: Style image, JPEG.
    """

    ply: Path
    cameras: Path
    style: Path


def build_demo(folder: Path) -> DemoScene:
    """Write the demo's scene, cameras and style image into a folder, and create the folder.

    Raises:
        OutputError: If the folder cannot be written.
    """
    ensure_writable_folder(folder)
    demo = DemoScene(folder / "motorcycle.ply", folder / "cameras.json", folder / "starry_night.jpg")
    write_scene(demo.ply, read_scene(FOLDER / "example" / "motorcycle.sog").scene)
    for source, path in ((FOLDER / "example" / "cameras.json", demo.cameras), (STARRY_NIGHT, demo.style)):
        with atomic_path(path) as temporary:
            shutil.copyfile(source, temporary)
    return demo
