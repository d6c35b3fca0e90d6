"""Stylize a scene on the service, and open it in Blender or LichtFeld Studio.

blender --python open_stylized.py -- scene.ply style.jpg stylized.ply
python open_stylized.py scene.ply style.jpg stylized.ply --viewer LichtFeld-Studio

Views are on an orbit around the scene; `--cameras` names a cameras.json. sgsst_rest.py is in the same folder.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

# Blender does not search the folder of the script.
sys.path.append(str(Path(__file__).resolve().parent))

from sgsst_rest import Service


def open_in_blender(path: Path) -> None:
    """Import a PLY into the open Blender file: a point for each Gaussian, with all properties as attributes."""
    import bpy

    bpy.ops.wm.ply_import(filepath=str(path), import_attributes=True)


def main(arguments: list[str]) -> None:
    """Stylize the scene of the arguments, and open the result."""
    parser = argparse.ArgumentParser(description="Stylize a 3DGS scene and open the result.")
    parser.add_argument("scene", type=Path)
    parser.add_argument("style", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--viewer", help="Program to open the result with, instead of Blender.")
    given = parser.parse_args(arguments)
    if given.cameras:
        Service().stylize(given.scene, given.style, given.out, [given.cameras], preset=given.preset)
    else:
        Service().stylize(given.scene, given.style, given.out, orbit=24, preset=given.preset)
    if given.viewer:
        subprocess.run([given.viewer, "--view", str(given.out)], check=True)
    else:
        open_in_blender(given.out)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
