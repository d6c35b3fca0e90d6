"""Compile the kernels that most tests use: `python -m tests.compile_kernels`.

They are cached on disk. Otherwise each process of the tests compiles them, and so does each of the service's confined
processes, which cannot write the cache.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch

from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.scene_file import read_scene
from sgsst_core.stylizing.stylize import stylize
from tests.networks import tiny_weights
from tests.small_scenes import style, wall, write_files

if __name__ == "__main__":
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        for degree in (0, 1):
            ply, cameras, _ = write_files(Path(folder), wall(sh_degree=degree))
            stylize(
                read_scene(ply), read_cameras(cameras), style(), weights=tiny_weights(), preset="preview", steps_sos=2
            )
